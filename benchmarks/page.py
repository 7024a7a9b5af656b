"""The page of a run with many recordings: time, memory and size, from the report file to the HTML file.

./dev bench page [--recordings N]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from measure import run, typical

JOB = Path(__file__).resolve().parents[1] / "configs" / "quickstart.yaml"
ROUNDS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, default=1000)
    parser.add_argument("--write", type=Path, help="only write the report file")
    arguments = parser.parse_args()
    recordings: int = arguments.recordings
    if arguments.write:
        write_report(arguments.write, recordings)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        report, page = folder / "run.json", folder / "run.html"
        # Another process writes the file: the peak memory of a child includes that of its parent at the start.
        run([sys.executable, __file__, "--recordings", str(recordings), "--write", report])
        command = [sys.executable, "-m", "mosaico_ingest", "report", report, "--html", page]
        sample = typical([run(command) for _ in range(ROUNDS)])
        print(f"{recordings:,} recordings, report file {report.stat().st_size / 1e6:.1f} MB")
        print(
            f"page {page.stat().st_size / 1e6:.2f} MB in {sample.wall_s:.2f} s "
            f"({sample.cpu_s:.2f} s CPU), peak memory {sample.peak_bytes / 1e6:.0f} MB"
        )


def write_report(path: Path, recordings: int) -> None:
    """Write a report in which the quickstart's recording is repeated."""
    from mosaico_ingest import api  # noqa: PLC0415 - the process that measures stays small
    from mosaico_ingest.report.run import RunReport  # noqa: PLC0415 - the process that measures stays small

    (job,) = api.compile_job(JOB)
    one = api.run([job.replace(target=job.target.replace(store=str(path.parent / "store")))]).recordings[0]
    copies = [
        one.replace(
            sequence=f"drive_{number:05}",
            duration_s=one.duration_s + number % 17,
            source_bytes=one.source_bytes + number,
        )
        for number in range(recordings)
    ]
    path.write_text(
        RunReport(tool="mosaico-ingest", recordings=tuple(copies)).model_dump_json(indent=2) + "\n"
    )


if __name__ == "__main__":
    main()
