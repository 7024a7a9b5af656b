"""Measure complete runs, from the recording to the committed sequence, and compare them with the floor and the official injector.

    ./dev bench                               all workloads, three runs each
    ./dev bench --quick                       short recordings, one run each
    ./dev bench --long                        four to five times longer recordings, which need 3 GB more
    ./dev bench --peer ~/sdk/bin/python       also the official injector, uploading to a server that discards all rows;
                                              the Python of a virtual environment with mosaicolabs
    ./dev bench --native RERUN                alternating with Rerun's converter and a plain copy; RERUN is the program
                                              of rerun-sdk, for example ~/rerun/bin/rerun
    ./dev bench --recording drive.mcap        your own recording

The floor reads and decompresses every chunk, then writes prepared tables of the same rows with the same settings.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import native
from measure import Sample, run, typical
from workloads import BY_NAME, LONG, SHORT, WORKLOADS, Workload

HERE = Path(__file__).parent
MAX_PEAK_MIB = 512
INGEST = (sys.executable, "-m", "mosaico_ingest")


@dataclass(frozen=True)
class Case:
    """A recording to measure, the recording for the official injector, and the targets."""

    name: str
    recording: Path
    for_peer: Path
    min_peer_ratio: float = 0.0
    max_floor_ratio: float = 0.0
    injector: str = "mosaicolabs.ros_injector"
    """The program of the official SDK that ingests the recording."""


@dataclass(frozen=True)
class Result:
    """The figures of a case; the official injector is measured in messages per second, because its recording can be shorter."""

    case: Case
    messages: int
    ours: Sample
    floor_s: float
    stored_bytes: int
    peer_per_s: float | None

    @property
    def per_s(self) -> float:
        return self.messages / self.ours.wall_s

    def record(self) -> dict[str, object]:
        return {
            "workload": self.case.name,
            "messages": self.messages,
            "source_bytes": self.case.recording.stat().st_size,
            "stored_bytes": self.stored_bytes,
            "wall_s": self.ours.wall_s,
            "cpu_s": self.ours.cpu_s,
            "peak_bytes": self.ours.peak_bytes,
            "messages_per_s": self.per_s,
            "floor_s": self.floor_s,
            "times_floor": self.ours.wall_s / self.floor_s,
            "peer_messages_per_s": self.peer_per_s,
            "times_peer": self.per_s / self.peer_per_s if self.peer_per_s else None,
        }


def measure(case: Case, runs: int, peer: Path | None) -> Result:
    with tempfile.TemporaryDirectory(dir=HERE / "data") as folder:
        store, report = Path(folder) / "store", Path(folder) / "report.json"
        samples: list[Sample] = []
        for _ in range(runs):
            shutil.rmtree(store, ignore_errors=True)
            samples.append(
                run(
                    [
                        *INGEST,
                        "bag",
                        case.recording,
                        "--name",
                        "run",
                        "--store",
                        store,
                        "--report",
                        report,
                        "-q",
                    ]
                )
            )
        floors = [floor_seconds(case.recording, store) for _ in range(runs)]
        stored_bytes = sum(file.stat().st_size for file in store.rglob("*.parquet"))
        messages = sum(
            topic["written"] for topic in json.loads(report.read_text())["recordings"][0]["topics"]
        )
    peer_per_s = peer_speed(case.for_peer, runs, peer, case.injector) if peer else None
    return Result(case, messages, typical(samples), sorted(floors)[runs // 2], stored_bytes, peer_per_s)


def floor_seconds(recording: Path, store: Path) -> float:
    """Return the time of the floor without the time to load its tables."""
    sample = run([sys.executable, HERE / "floor.py", recording, store])
    return sample.wall_s - json.loads(sample.output)["load_s"]


def peer_speed(recording: Path, runs: int, python: Path, injector: str = "mosaicolabs.ros_injector") -> float:
    """Return the speed of the official injector, in messages per second."""
    samples: list[Sample] = []
    rows = 0
    for _ in range(runs):
        with discard_server() as (port, counted):
            program = python.parent / injector
            command = [program, recording, "--name", "run", "--host", "127.0.0.1", "--port", port]
            samples.append(run([*command, "--log", "ERROR"]))
        rows = counted[0]
    return rows / typical(samples).wall_s


def peer_seconds(recording: Path, python: Path, injector: str) -> float:
    """Return the time of the official injector for the complete recording, in one run."""
    with discard_server() as (port, _):
        command = [
            python.parent / injector,
            recording,
            "--name",
            "run",
            "--host",
            "127.0.0.1",
            "--port",
            port,
        ]
        return run([*command, "--log", "ERROR"]).wall_s


@contextmanager
def discard_server() -> Iterator[tuple[str, list[int]]]:
    """Run the server that discards rows; yield its port and a list to which the number of rows is added at the end."""
    server = subprocess.Popen(
        [sys.executable, HERE / "discard_server.py"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert server.stdout is not None
    counted: list[int] = []
    try:
        yield server.stdout.readline().strip(), counted
        rows, _ = server.communicate()
        counted.append(int(rows))
    finally:
        server.kill()
        server.wait()


def cases(arguments: argparse.Namespace) -> list[Case]:
    """Return the selected cases, and generate missing recordings."""
    if arguments.recording:
        return [Case(path.name, path, path) for path in arguments.recording]
    selected = [*SHORT, *WORKLOADS[3:]] if arguments.quick else LONG if arguments.long else WORKLOADS
    workloads = [workload for workload in selected if not arguments.only or workload.name in arguments.only]
    return [_case(workload, arguments.data) for workload in workloads]


def _case(workload: Workload, folder: Path) -> Case:
    path = workload.path(folder)
    short = BY_NAME[workload.peer].path(folder) if workload.peer else path
    injector = "mosaicolabs.mcap_injector" if workload.write else "mosaicolabs.ros_injector"
    return Case(workload.name, path, short, workload.min_peer_ratio, workload.max_floor_ratio, injector)


def print_result(result: Result) -> None:
    case, ours = result.case, result.ours
    floor, size = ours.wall_s / result.floor_s, case.recording.stat().st_size
    peer = result.per_s / result.peer_per_s if result.peer_per_s else 0.0
    missed = [
        *(["floor"] if case.max_floor_ratio and floor > case.max_floor_ratio else []),
        *(["peer"] if peer and peer < case.min_peer_ratio else []),
        *(["memory"] if ours.peak_bytes >> 20 > MAX_PEAK_MIB else []),
    ]
    print(
        f"| {case.name} | {result.messages:,} | {size / 1e6:.0f} MB | {ours.wall_s:.2f} s | {ours.cpu_s:.2f} s "
        f"| {result.per_s:,.0f}/s | {size / 1e6 / ours.wall_s:.0f} MB/s | {ours.peak_bytes >> 20} MiB "
        f"| {size / result.stored_bytes:.2f} | {floor:.2f}x | {f'{peer:.0f}x' if peer else '-'} |"
        + (f" missed: {', '.join(missed)}" if missed else ""),
        flush=True,
    )


HEAD = """| workload | messages | recording | time | CPU | messages/s | throughput | peak memory | size ratio | time / floor | speed / peer |
|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"""


def start_up(folder: Path, runs: int) -> dict[str, float]:
    """Return the seconds of commands whose time must not depend on the length of a recording."""
    long, short = BY_NAME["telemetry"].path(folder), BY_NAME["telemetry-30s"].path(folder)
    commands = {
        "ingest --help": ["--help"],
        "ingest inspect, 30 s": ["inspect", short],
        "ingest inspect, 300 s": ["inspect", long],
    }
    return {
        name: typical([run([*INGEST, *rest]) for _ in range(runs)]).wall_s for name, rest in commands.items()
    }


def compare_native(arguments: argparse.Namespace, runs: int) -> None:
    """Compare the selected MCAP recordings with Rerun's converter, which reads no other format."""
    print(native.HEAD)
    contests: list[native.Contest] = []
    for case in cases(arguments):
        if case.recording.suffix != ".mcap":
            continue
        contest = native.compare(
            case.recording,
            INGEST,
            arguments.native,
            runs=runs,
            folder=HERE / "data",
            floor_seconds=floor_seconds,
        )
        if arguments.peer:
            contest.peer_s = peer_seconds(case.recording, arguments.peer, case.injector)
        native.print_contest(contest)
        contests.append(contest)
    native.print_differences(contests)
    native.write_contests(contests, arguments.json)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="short recordings, one run each")
    parser.add_argument("--long", action="store_true", help="long recordings")
    parser.add_argument("--runs", type=int, default=0, help="runs per workload (default: 3)")
    parser.add_argument("--only", action="append", help="name of a workload; repeatable")
    parser.add_argument("--recording", type=Path, action="append", help="your own recording; repeatable")
    parser.add_argument(
        "--peer", type=Path, metavar="PYTHON", help="Python of a virtual environment with mosaicolabs"
    )
    parser.add_argument("--native", type=Path, metavar="RERUN", help="the program `rerun` of rerun-sdk 0.41")
    parser.add_argument("--data", type=Path, default=HERE / "data", help="folder of the generated recordings")
    parser.add_argument(
        "--json", type=Path, default=HERE / "data" / "results.json", help="file for the figures"
    )
    arguments = parser.parse_args()
    runs = arguments.runs or (1 if arguments.quick else 3)
    (HERE / "data").mkdir(exist_ok=True)
    run([*INGEST, "--help"])  # compile the sources before the first measured run
    if arguments.native:
        compare_native(arguments, runs)
        return
    print(HEAD)
    results: list[Result] = []
    for case in cases(arguments):
        results.append(measure(case, runs, arguments.peer))
        print_result(results[-1])
    figures: dict[str, object] = {
        "date": datetime.now(timezone.utc).isoformat(timespec="minutes"),
        "machine": {
            "system": platform.platform(),
            "cpus": os.cpu_count(),
            "python": platform.python_version(),
        },
        "runs": runs,
        "workloads": [result.record() for result in results],
    }
    if not (arguments.recording or arguments.only or arguments.long):
        figures["start_up_s"] = seconds = start_up(arguments.data, runs)
        print(*(f"{name}: {duration:.2f} s" for name, duration in seconds.items()), sep="\n")
    arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
