"""Measures one job over five short recordings: what each takes where a process starts once for all of them.

    ./dev bench job [--runs 3] [--peer ~/sdk/bin/python] [--data FOLDER]

With `--peer` also the official injector, which takes one recording a process.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

from measure import Sample, run, typical
from run import INGEST, peer_speed
from workloads import BY_NAME

HERE = Path(__file__).parent
SHORT = ("mixed", "mixed-sqlite", "mixed-ros1", "mixed-ros1-lz4", "layouts")
JOB = """version: 1
bag: {path: "recordings/*"}
sequence: {name: "{stem}"}
target: {store: store}
"""


def timed(recordings: list[Path], runs: int, data: Path) -> tuple[Sample, dict[str, int]]:
    """Return what a job over the recordings takes, and how many messages each has."""
    with tempfile.TemporaryDirectory(dir=data) as made:
        folder = Path(made)
        (folder / "recordings").mkdir()
        for recording in recordings:
            (folder / "recordings" / recording.name).symlink_to(recording.resolve())
        (folder / "job.yaml").write_text(JOB, encoding="utf-8")
        samples: list[Sample] = []
        for _ in range(runs):
            shutil.rmtree(folder / "store", ignore_errors=True)
            command = [*INGEST, "run", folder / "job.yaml", "--report", folder / "report.json", "-q"]
            samples.append(run(command))
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        counts = {one["sequence"]: one["totals"]["written"] for one in report["recordings"]}
    return typical(samples), counts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=3, help="runs of each (3)")
    parser.add_argument("--peer", type=Path, metavar="PYTHON", help="the Python of a venv with mosaicolabs")
    parser.add_argument("--data", type=Path, default=HERE / "data", help="where the recordings are kept")
    arguments = parser.parse_args()
    recordings = [BY_NAME[name].path(arguments.data) for name in SHORT]
    run([*INGEST, "--help"])  # so that no run compiles the sources
    whole, counts = timed(recordings, arguments.runs, arguments.data)
    messages = sum(counts.values())
    one = whole.wall_s / len(recordings)
    print(
        f"one job: {len(recordings)} recordings, {messages:,} messages, {whole.wall_s:.2f} s, {one:.2f} s each"
    )
    if arguments.peer:
        speeds = {path: peer_speed(path, arguments.runs, arguments.peer) for path in recordings}
        seconds = sum(counts[path.stem] / speed for path, speed in speeds.items())
        print(
            f"the official injector, one process each: {seconds:.1f} s, {seconds / whole.wall_s:.0f} times as long"
        )


if __name__ == "__main__":
    main()
