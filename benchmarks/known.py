"""Measure the CPU time of a job whose recordings are all stored: `status` and `if_exists: skip`, per recording.

    ./dev bench known                     2,000 recordings of one topic, three runs each
    ./dev bench known --recordings 20000

The first run ingests the recordings and is not measured. `--verify` opens each recording, as for changed files.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from fleet import TINY
from measure import run
from workloads import Workload

INGEST = (sys.executable, "-m", "mosaico_ingest")
COMMANDS = {
    "status": ("status",),
    "skip": ("run", "--quiet"),
    "status --verify": ("status", "--verify"),
    "skip --verify": ("run", "--quiet", "--verify"),
}


def write_job(folder: Path, count: int) -> Path:
    """Write `count` copies of a recording, and their manifest."""
    (folder / "recordings").mkdir(parents=True)
    recording = Workload("one", TINY["1 topic"], 1.1, 1).path(folder)
    for number in range(count):
        shutil.copyfile(recording, folder / f"recordings/{number:06}{recording.suffix}")
    job = folder / "job.yaml"
    job.write_text(
        'version: 1\nbag: {path: "recordings/*"}\nsequence: {name: "{stem}", if_exists: skip}\n'
        "target: {store: store}\n"
    )
    return job


def cpu_s(*arguments: str | Path, runs: int) -> float:
    """Return the lowest CPU time of some runs of `ingest`."""
    return min(run([*INGEST, *arguments]).cpu_s for _ in range(runs))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=int, default=2000, help="number of recordings (default: 2000)")
    parser.add_argument("--runs", type=int, default=3, help="runs per figure (default: 3)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        jobs = [write_job(Path(name) / str(count), count) for count in (1, arguments.recordings)]
        for job in jobs:
            run([*INGEST, "run", "--quiet", job])
        print("| | one recording | all | per recording |\n|---|---:|---:|---:|")
        for label, command in COMMANDS.items():
            one_s, all_s = (cpu_s(command[0], job, *command[1:], runs=arguments.runs) for job in jobs)
            each_ms = (all_s - one_s) / (arguments.recordings - 1) * 1e3
            print(f"| {label} | {one_s:.2f} s | {all_s:.2f} s | {each_ms:.2f} ms |", flush=True)


if __name__ == "__main__":
    main()
