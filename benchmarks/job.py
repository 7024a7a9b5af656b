"""Measure one job over five short recordings, to see the time per recording without the start of a process.

    ./dev bench job [--runs 3] [--peer ~/sdk/bin/python] [--data FOLDER]

`--peer` also measures the official injector, which needs one process per recording.
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


def measure_job(recordings: list[Path], runs: int, data: Path) -> tuple[Sample, dict[str, int]]:
    """Return the figures of a job over the recordings, and the number of messages per recording."""
    with tempfile.TemporaryDirectory(dir=data) as name:
        folder = Path(name)
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
    parser.add_argument("--runs", type=int, default=3, help="number of runs (default: 3)")
    parser.add_argument(
        "--peer", type=Path, metavar="PYTHON", help="Python of a virtual environment with mosaicolabs"
    )
    parser.add_argument("--data", type=Path, default=HERE / "data", help="folder of the generated recordings")
    arguments = parser.parse_args()
    recordings = [BY_NAME[name].path(arguments.data) for name in SHORT]
    run([*INGEST, "--help"])  # compile the sources before the first measured run
    sample, counts = measure_job(recordings, arguments.runs, arguments.data)
    messages = sum(counts.values())
    each_s = sample.wall_s / len(recordings)
    print(
        f"one job: {len(recordings)} recordings, {messages:,} messages, {sample.wall_s:.2f} s, {each_s:.2f} s each"
    )
    if arguments.peer:
        speeds = {path: peer_speed(path, arguments.runs, arguments.peer) for path in recordings}
        seconds = sum(counts[path.stem] / speed for path, speed in speeds.items())
        print(
            f"official injector, one process per recording: {seconds:.1f} s, {seconds / sample.wall_s:.0f} times as long"
        )


if __name__ == "__main__":
    main()
