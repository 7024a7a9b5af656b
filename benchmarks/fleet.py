"""Measures a batch: 64 recordings of mixed sizes in one process, in two and on Ray, and what a recording costs by itself.

    ./dev bench fleet                 three runs each; Ray where the extra is installed
    ./dev bench fleet --runs 1        faster

The overhead is measured on recordings that hold next to nothing: what 64 of them take, less what one takes (which is
start-up), for each of the 63.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from workloads import LIDAR, MIXED, TELEMETRY, Topic, Workload, cameras

HERE = Path(__file__).parent
COUNT = 64
SEED = 8
MOST_OVERHEAD_MS = 50
LOOK_S = 0.25
KINDS = {"telemetry": TELEMETRY, "mixed": MIXED, "lidar": LIDAR, "cameras": cameras(1)}
SUFFIXES = (".mcap", ".mcap", ".db3", ".bag")
FEW = tuple(replace(topic, hertz=10) for topic in TELEMETRY)
TINY = {"1 topic": FEW[:1], "11 topics": FEW}
WAYS = {
    "1 process": ("--jobs", "1"),
    "2 processes": ("--jobs", "2"),
    "Ray, 2 CPUs": ("--executor", "ray", "--jobs", "2"),
}


@dataclass(frozen=True)
class Sample:
    """One batch: seconds, and the largest resident size of any process that ingests."""

    wall_s: float
    peak_bytes: int


def fleet(folder: Path) -> Path:
    """Return a folder of 64 recordings of half a second to 16 s of four kinds, after making what is not there."""
    random = np.random.default_rng(SEED)
    for number in range(COUNT):
        kind = list(KINDS)[int(random.integers(len(KINDS)))]
        suffix = SUFFIXES[int(random.integers(len(SUFFIXES)))]
        seconds = float(np.exp(random.uniform(np.log(0.5), np.log(16))))
        compression = "none" if suffix == ".db3" else "lz4" if suffix == ".bag" else "zstd"
        Workload(f"{number:02}-{kind}", KINDS[kind], seconds, SEED + number, suffix, compression).path(folder)
    return folder


def tiny(folder: Path, topics: tuple[Topic, ...]) -> Path:
    """Return a folder of 64 recordings of eleven messages on each topic."""
    for number in range(COUNT):
        Workload(f"{number:02}", topics, 1.1, SEED + number).path(folder)
    return folder


def batch(folder: Path, recordings: Path, pattern: str, way: Sequence[str], *, look: bool) -> Sample:
    """Run a job over a folder of recordings into a new store in `folder`, as a whole process; look at its memory or not."""
    name = Path(tempfile.mkdtemp(dir=folder))
    job, report = name / "job.yaml", name / "run.json"
    job.write_text(
        f'version: 1\nbag: {{path: "{recordings.resolve()}/{pattern}"}}\nsequence: {{name: "{{stem}}"}}\n'
    )
    command = [sys.executable, "-m", "mosaico_ingest", "run", job, "--report", report, "--quiet", *way]
    start = time.perf_counter()
    with subprocess.Popen(list(map(str, command)), cwd=name, stdout=subprocess.DEVNULL) as child:
        peaks = {child.pid: 0}
        while look and child.poll() is None:
            peaks |= _peaks(child.pid)
            time.sleep(LOOK_S)
        child.wait()
    wall_s = time.perf_counter() - start
    if child.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed ({child.returncode})")
    done = json.loads(report.read_text())["recordings"]
    assert all(one["status"] == "completed" for one in done)
    return Sample(wall_s, max(peaks.values()))


def _peaks(ingest: int) -> dict[int, int]:
    """Return the highest resident size so far of the processes that ingest: the workers, or the command itself."""
    parents: dict[int, int] = {}
    workers: dict[int, int] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            status = dict(line.split(":\t", 1) for line in (entry / "status").read_text().splitlines())
            command = (entry / "cmdline").read_text()
        except (OSError, ValueError):
            continue  # no process, or one that has just ended
        if "VmHWM" in status:
            number = int(entry.name)
            parents[number] = int(status["PPid"])
            if number == ingest or "spawn_main" in command or command.startswith("ray::"):
                workers[number] = int(status["VmHWM"].split()[0]) << 10
    ours = {number: peak for number, peak in workers.items() if _descends(number, ingest, parents)}
    return {number: peak for number, peak in ours.items() if number != ingest} or ours


def _descends(number: int, ancestor: int, parents: dict[int, int]) -> bool:
    while number in parents and number != ancestor:
        number = parents[number]
    return number == ancestor


def fastest(
    folder: Path, recordings: Path, pattern: str, way: Sequence[str], runs: int, *, look: bool = False
) -> Sample:
    samples = [batch(folder, recordings, pattern, way, look=look) for _ in range(runs)]
    return Sample(min(one.wall_s for one in samples), max(one.peak_bytes for one in samples))


def measure_fleet(recordings: Path, ways: dict[str, tuple[str, ...]], runs: int) -> list[dict[str, object]]:
    """Print and return what the mixed recordings take, each way."""
    files = list(recordings.iterdir())
    size = sum(file.stat().st_size for file in files)
    largest = max(file.stat().st_size for file in files)
    print(f"{len(files)} recordings, {size / 1e6:,.0f} MB, the largest {largest / 1e6:.0f} MB\n")
    print("| | time | speed-up | bytes | memory of a worker |\n|---|---:|---:|---:|---:|")
    figures: list[dict[str, object]] = []
    alone_s = 0.0
    for name, way in ways.items():
        with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
            took = fastest(Path(folder), recordings, "*", way, runs, look=True)
        alone_s = alone_s or took.wall_s
        print(
            f"| {name} | {took.wall_s:.1f} s | {alone_s / took.wall_s:.2f} "
            f"| {size / 1e6 / took.wall_s:.0f} MB/s | {took.peak_bytes >> 20} MiB |",
            flush=True,
        )
        figures.append({"way": name, "bytes": size, "wall_s": took.wall_s, "peak_bytes": took.peak_bytes})
    return figures


def measure_overhead(
    folder: Path, data: Path, ways: dict[str, tuple[str, ...]], runs: int
) -> list[dict[str, object]]:
    """Print and return what a recording costs that holds next to nothing, each way.

    All stores stay in `folder`: where many files were removed a moment ago, ext4 takes four times as long to make one.
    """
    print("| | start-up | 64 recordings | each |\n|---|---:|---:|---:|")
    figures: list[dict[str, object]] = []
    for kind, topics in TINY.items():
        recordings = tiny(data / f"fleet-{kind.replace(' ', '-')}", topics)
        for name, way in ways.items():
            one = fastest(folder, recordings, "00.*", way, runs).wall_s
            all_of_them = fastest(folder, recordings, "*", way, runs).wall_s
            each_ms = (all_of_them - one) / (COUNT - 1) * 1e3
            missed = " missed" if each_ms > MOST_OVERHEAD_MS else ""
            print(
                f"| {kind}, {name} | {one:.2f} s | {all_of_them:.2f} s | {each_ms:.0f} ms |{missed}",
                flush=True,
            )
            figures.append({"kind": kind, "way": name, "start_s": one, "each_ms": each_ms})
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--runs", type=int, default=3, help="runs of each; the fastest counts, as other work only adds (3)"
    )
    parser.add_argument("--data", type=Path, default=HERE / "data", help="where the recordings are kept")
    parser.add_argument("--json", type=Path, default=HERE / "data" / "fleet.json", help="where figures go")
    given = parser.parse_args()
    (HERE / "data").mkdir(exist_ok=True)
    ways = dict(WAYS)
    if find_spec("ray") is None:
        del ways["Ray, 2 CPUs"]
        print("Ray is not installed (pip install 'mosaico-ingest[ray]'): left out\n")
    with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
        tiny_ones = measure_overhead(Path(folder), given.data, ways, given.runs)
    print()
    mixed = measure_fleet(fleet(given.data / "fleet-mixed"), ways, given.runs)
    date = datetime.now(timezone.utc).isoformat(timespec="minutes")
    figures = {"date": date, "cpus": os.cpu_count(), "runs": given.runs, "mixed": mixed, "tiny": tiny_ones}
    given.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
