"""Measure a batch: 64 recordings of mixed sizes in one process, in two processes and on Ray, and the overhead per recording.

    ./dev bench fleet                 three runs each; Ray only if it is installed
    ./dev bench fleet --runs 1        one run each

The overhead per recording is measured with tiny recordings: the time of 64 of them, minus the time of one (start-up),
divided by 63. The floor copies the mixed recordings with as many processes, each of which waits until its copy is on the
disk.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
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
MAX_OVERHEAD_MS = 50
POLL_S = 0.25
KINDS = {"telemetry": TELEMETRY, "mixed": MIXED, "lidar": LIDAR, "cameras": cameras(1)}
SUFFIXES = (".mcap", ".mcap", ".db3", ".bag")
FEW = tuple(replace(topic, hertz=10) for topic in TELEMETRY)
TINY = {"1 topic": FEW[:1], "11 topics": FEW}
EXECUTORS = {
    "1 process": ("--jobs", "1"),
    "2 processes": ("--jobs", "2"),
    "Ray, 2 CPUs": ("--executor", "ray", "--jobs", "2"),
}


@dataclass(frozen=True)
class Sample:
    """The figures of one batch; the peak memory is the maximum over all processes that ingest."""

    wall_s: float
    cpu_s: float
    peak_bytes: int


def fleet(folder: Path) -> Path:
    """Return the folder of 64 recordings of four types and 0.5 to 16 s, and generate missing recordings."""
    random = np.random.default_rng(SEED)
    for number in range(COUNT):
        kind = list(KINDS)[int(random.integers(len(KINDS)))]
        suffix = SUFFIXES[int(random.integers(len(SUFFIXES)))]
        seconds = float(np.exp(random.uniform(np.log(0.5), np.log(16))))
        compression = "none" if suffix == ".db3" else "lz4" if suffix == ".bag" else "zstd"
        Workload(f"{number:02}-{kind}", KINDS[kind], seconds, SEED + number, suffix, compression).path(folder)
    return folder


def tiny(folder: Path, topics: tuple[Topic, ...]) -> Path:
    """Return the folder of 64 recordings with eleven messages per topic, and generate missing recordings."""
    for number in range(COUNT):
        Workload(f"{number:02}", topics, 1.1, SEED + number).path(folder)
    return folder


def batch(folder: Path, recordings: Path, pattern: str, options: Sequence[str], *, look: bool) -> Sample:
    """Ingest a folder of recordings into a new store in `folder`; with `look`, also measure the memory of all processes."""
    name = Path(tempfile.mkdtemp(dir=folder))
    job, report = name / "job.yaml", name / "run.json"
    job.write_text(
        f'version: 1\nbag: {{path: "{recordings.resolve()}/{pattern}"}}\nsequence: {{name: "{{stem}}"}}\n'
    )
    command = [sys.executable, "-m", "mosaico_ingest", "run", job, "--report", report, "--quiet", *options]
    start, start_cpu_s = time.perf_counter(), cpu_of_children_s()
    with subprocess.Popen(list(map(str, command)), cwd=name, stdout=subprocess.DEVNULL) as child:
        peaks = {child.pid: 0}
        while look and child.poll() is None:
            peaks |= _peaks(child.pid)
            time.sleep(POLL_S)
        child.wait()
    wall_s = time.perf_counter() - start
    if child.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed ({child.returncode})")
    recordings_done = json.loads(report.read_text())["recordings"]
    assert all(one["status"] == "completed" for one in recordings_done)
    return Sample(wall_s, cpu_of_children_s() - start_cpu_s, max(peaks.values()))


def cpu_of_children_s() -> float:
    """Return the CPU time of all processes that this process, or one of its children, waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def copy(recordings: Path, processes: int) -> float:
    """Return the seconds for copying the recordings to the disk."""
    with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
        command = ["xargs", "-0", "-n", "1", "-P", str(processes), "sh", "-c"]
        command += ['cp "$1" "$0" && sync "$0/${1##*/}"', folder]
        names = "\0".join(str(path.resolve()) for path in sorted(recordings.iterdir()))
        start = time.perf_counter()
        subprocess.run(command, input=names, text=True, check=True)
        return time.perf_counter() - start


def _peaks(ingest: int) -> dict[int, int]:
    """Return the peak memory so far of each process that ingests: the workers, or the command itself."""
    parents: dict[int, int] = {}
    workers: dict[int, int] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            status = dict(line.split(":\t", 1) for line in (entry / "status").read_text().splitlines())
            command = (entry / "cmdline").read_text()
        except (OSError, ValueError):
            continue  # not a process, or it has ended
        if "VmHWM" in status:
            number = int(entry.name)
            parents[number] = int(status["PPid"])
            if number == ingest or "spawn_main" in command or command.startswith("ray::"):
                workers[number] = int(status["VmHWM"].split()[0]) << 10
    descendants = {number: peak for number, peak in workers.items() if _descends(number, ingest, parents)}
    return {number: peak for number, peak in descendants.items() if number != ingest} or descendants


def _descends(number: int, ancestor: int, parents: dict[int, int]) -> bool:
    while number in parents and number != ancestor:
        number = parents[number]
    return number == ancestor


def fastest(
    folder: Path, recordings: Path, pattern: str, options: Sequence[str], runs: int, *, look: bool = False
) -> Sample:
    samples = [batch(folder, recordings, pattern, options, look=look) for _ in range(runs)]
    return Sample(
        min(one.wall_s for one in samples),
        min(one.cpu_s for one in samples),
        max(one.peak_bytes for one in samples),
    )


def measure_fleet(
    recordings: Path, executors: dict[str, tuple[str, ...]], runs: int
) -> list[dict[str, object]]:
    """Print and return the figures of the mixed recordings for each executor."""
    files = list(recordings.iterdir())
    size = sum(file.stat().st_size for file in files)
    largest = max(file.stat().st_size for file in files)
    print(f"{len(files)} recordings, {size / 1e6:,.0f} MB, largest {largest / 1e6:.0f} MB\n")
    print("| | time | speed-up | CPU | throughput | memory of a worker |\n|---|---:|---:|---:|---:|---:|")
    figures: list[dict[str, object]] = []
    single_s = 0.0
    for processes in (1, 2):
        copy_s = min(copy(recordings, processes) for _ in range(runs))
        single_s = single_s or copy_s
        print(
            f"| floor: copy and sync, {processes} processes | {copy_s:.1f} s | {single_s / copy_s:.2f} | "
            f"| {size / 1e6 / copy_s:.0f} MB/s | |",
            flush=True,
        )
        figures.append({"floor": processes, "bytes": size, "wall_s": copy_s})
    single_s = 0.0
    for name, options in executors.items():
        with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
            sample = fastest(Path(folder), recordings, "*", options, runs, look=True)
        single_s = single_s or sample.wall_s
        print(
            f"| {name} | {sample.wall_s:.1f} s | {single_s / sample.wall_s:.2f} | {sample.cpu_s:.1f} s "
            f"| {size / 1e6 / sample.wall_s:.0f} MB/s | {sample.peak_bytes >> 20} MiB |",
            flush=True,
        )
        figures.append(
            {
                "executor": name,
                "bytes": size,
                "wall_s": sample.wall_s,
                "cpu_s": sample.cpu_s,
                "peak_bytes": sample.peak_bytes,
            }
        )
    return figures


def measure_overhead(
    folder: Path, data: Path, executors: dict[str, tuple[str, ...]], runs: int
) -> list[dict[str, object]]:
    """Print and return the overhead per recording for each executor.

    All stores stay in `folder`, because ext4 takes four times as long to create files after many files were removed.
    """
    print("| | start-up | 64 recordings | per recording | CPU per recording |\n|---|---:|---:|---:|---:|")
    figures: list[dict[str, object]] = []
    for kind, topics in TINY.items():
        recordings = tiny(data / f"fleet-{kind.replace(' ', '-')}", topics)
        for name, options in executors.items():
            one = fastest(folder, recordings, "00.*", options, runs)
            every = fastest(folder, recordings, "*", options, runs)
            each_ms = (every.wall_s - one.wall_s) / (COUNT - 1) * 1e3
            each_cpu_ms = (every.cpu_s - one.cpu_s) / (COUNT - 1) * 1e3
            missed = " missed" if each_ms > MAX_OVERHEAD_MS else ""
            print(
                f"| {kind}, {name} | {one.wall_s:.2f} s | {every.wall_s:.2f} s | {each_ms:.1f} ms "
                f"| {each_cpu_ms:.1f} ms |{missed}",
                flush=True,
            )
            figures.append(
                {
                    "kind": kind,
                    "executor": name,
                    "start_s": one.wall_s,
                    "each_ms": each_ms,
                    "each_cpu_ms": each_cpu_ms,
                }
            )
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--runs", type=int, default=3, help="runs per figure, of which the fastest counts (default: 3)"
    )
    parser.add_argument("--data", type=Path, default=HERE / "data", help="folder of the generated recordings")
    parser.add_argument(
        "--json", type=Path, default=HERE / "data" / "fleet.json", help="file for the figures"
    )
    arguments = parser.parse_args()
    (HERE / "data").mkdir(exist_ok=True)
    executors = dict(EXECUTORS)
    if find_spec("ray") is None:
        del executors["Ray, 2 CPUs"]
        print("Ray is not installed (pip install '.[ray]') and is skipped\n")
    with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
        overhead = measure_overhead(Path(folder), arguments.data, executors, arguments.runs)
    print()
    mixed = measure_fleet(fleet(arguments.data / "fleet-mixed"), executors, arguments.runs)
    date = datetime.now(timezone.utc).isoformat(timespec="minutes")
    figures = {"date": date, "cpus": os.cpu_count(), "runs": arguments.runs, "mixed": mixed, "tiny": overhead}
    arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
