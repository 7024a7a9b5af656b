"""Measure the cost of data contracts: in a run, and as checks without a run, compared with other tools.

    python benchmarks/contracts.py [--runs 5] [--data FOLDER] [--tracecheck PROGRAM] [--pymcap-cli PROGRAM] [--only NAME]
        [--instructions]

Shares of a run refer to CPU time, which other load affects less than wall time; runs with and without a contract alternate.
The checks of all tools are complete processes with equivalent contracts that hold.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
from measure import Sample, run, typical
from workloads import BY_NAME

from mosaico_ingest.rosbag.blocks import Connection
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

HERE = Path(__file__).parent
INGEST = (sys.executable, "-m", "mosaico_ingest")
RECORDINGS = ("telemetry", "cameras", "mixed")
TIMES = '    "*": {rate: {min: 0.001 Hz}, gap: {max: 1h}, coverage: {min: 0%, gap: 1h}}\n'
HEADERS = '    "*": {rate: {min: 0.001 Hz}, gap: {max: 1h}, latency: {max: 100000d}, stamps: [monotonic]}\n'
FIELDS = 10


class Contracts:
    """The equivalent contracts of one recording for each tool."""

    def __init__(self, recording: Path, folder: Path) -> None:
        with open_recording(recording, resolve=TypeResolver()) as opened:
            self.connections = [one for one in opened.connections if one.count and one.definition]
        self.recording = recording
        self.folder = folder

    def fields(self) -> dict[str, list[str]]:
        """Return ten numeric fields by topic, starting with the topics that have the most messages."""
        chosen: dict[str, list[str]] = {}
        for connection in sorted(self.connections, key=lambda one: -(one.count or 0)):
            for leaf in list(leaves(connection))[:4]:
                if sum(map(len, chosen.values())) < FIELDS:
                    chosen.setdefault(connection.topic, []).append(leaf)
        return chosen

    def manifest(self, name: str, topics: str) -> Path:
        """Write a manifest with the expectations of `topics`, or without a contract if it is empty."""
        path = self.folder / f"{name}.yaml"
        expect = f"expect:\n  on_failure: warn\n  topics:\n{topics}" if topics else ""
        path.write_text(
            f"bag: {{path: '{self.recording}'}}\nsequence: {{name: run}}\n"
            f"target: {{store: '{self.folder / 'store'}'}}\n{expect}"
        )
        return path

    def values(self) -> str:
        """Return the expectations of the ten fields."""
        return "".join(
            f"    {topic}: {{fields: {{{', '.join(f'{leaf}: {{between: [-1e300, 1e300]}}' for leaf in of_topic)}}}}}\n"
            for topic, of_topic in self.fields().items()
        )

    def tracecheck(self) -> Path:
        """Write the contract of rates, gaps and coverage for tracecheck."""
        with open_recording(self.recording, resolve=TypeResolver()) as opened:
            interval = [opened.start_ns, opened.end_ns]
        topics = {
            one.topic: {
                "required": True,
                "min_rate_hz": 0.001,
                "max_gap_ns": 3_600_000_000_000,
                "interval_ns": interval,
                "boundary_tolerance_ns": ((interval[1] or 0) - (interval[0] or 0)) // 2,
            }
            for one in self.connections
        }
        path = self.folder / "tracecheck.json"
        path.write_text(json.dumps({"version": 1, "name": "bench", "topics": topics}))
        return path

    def pymcap(self) -> Path:
        """Write the contract of the ten fields for pymcap-cli."""
        topics = {
            f"t{number}": {
                "topic": topic,
                "values": [{"path": f".{leaf}", "min": -(10**15), "max": 10**15} for leaf in of_topic],
            }
            for number, (topic, of_topic) in enumerate(self.fields().items())
        }
        path = self.folder / "pymcap.yaml"
        path.write_text(json.dumps({"version": 1, "topics": topics}))
        return path


def leaves(connection: Connection) -> Iterator[str]:
    """Yield the numeric fields of a message that are in no list and no header, the deepest last."""
    if connection.definition is None:
        return
    waiting = [("", ros_shape(connection.definition))]
    while waiting:
        prefix, struct = waiting.pop(0)
        for field in struct:
            path = f"{prefix}{field.name}"
            if pa.types.is_struct(field.type) and path != "header":
                waiting.append((f"{path}.", field.type))
            elif pa.types.is_floating(field.type) or pa.types.is_integer(field.type):
                yield path


def alternate(commands: dict[str, list[str | Path]], runs: int, store: Path) -> dict[str, Sample]:
    """Return the median figures of each command; the commands take turns."""
    samples: dict[str, list[Sample]] = {name: [] for name in commands}
    for _ in range(runs):
        for name, command in commands.items():
            shutil.rmtree(store, ignore_errors=True)
            shutil.rmtree(store.parent / "report", ignore_errors=True)
            samples[name].append(run(command))
    return {name: typical(of_command) for name, of_command in samples.items()}


def instructions(command: list[str | Path], store: Path) -> int:
    """Return the number of instructions of a command in user mode, in millions; the median of three runs."""
    counts: list[int] = []
    for _ in range(3):
        shutil.rmtree(store, ignore_errors=True)
        counting = ["perf", "stat", "-x,", "-e", "instructions:u", *command]
        text = subprocess.run(counting, check=True, capture_output=True, text=True).stderr
        counts.append(int(text.splitlines()[-1].partition(",")[0]) // 1_000_000)
    return sorted(counts)[1]


def print_runs(name: str, contracts: Contracts, runs: int, *, counts_instructions: bool) -> None:
    """Print the CPU time or the instructions of a run, and what the contracts add to it."""
    manifests = {
        "none": contracts.manifest("none", ""),
        "headers": contracts.manifest("headers", HEADERS),
        "fields": contracts.manifest("fields", HEADERS + contracts.values()),
    }
    commands: dict[str, list[str | Path]] = {key: [*INGEST, path, "-q"] for key, path in manifests.items()}
    store = contracts.folder / "store"
    if counts_instructions:
        costs: dict[str, float] = {key: instructions(command, store) for key, command in commands.items()}
        cost = f"{costs['none']:,.0f} million"
    else:
        costs = {key: sample.cpu_s for key, sample in alternate(commands, runs, store).items()}
        cost = f"{costs['none']:.2f} s"
    added = [f"{100 * (costs[key] / costs['none'] - 1):+.1f} %" for key in ("headers", "fields")]
    print(f"| {name} | {cost} | {added[0]} | {added[1]} |", flush=True)


def print_checks(
    name: str, contracts: Contracts, runs: int, tracecheck: str | None, pymcap: str | None
) -> None:
    """Print the wall time and the CPU time of `ingest check` and of the other tools."""
    folder = contracts.folder
    commands: dict[str, list[str | Path]] = {
        "times": [*INGEST, "check", contracts.manifest("times", TIMES)],
        "values": [*INGEST, "check", contracts.manifest("values", contracts.values())],
    }
    if tracecheck is not None:
        options = ["--out", folder / "report", "--quiet", "--fail-on", "fail", "--ignore-missing-crc"]
        commands["tracecheck"] = [
            tracecheck, "check", contracts.recording, "--contract", contracts.tracecheck(), *options,
        ]  # fmt: skip
    if pymcap is not None:
        commands["pymcap-cli"] = [pymcap, "check", contracts.recording, "--spec", contracts.pymcap()]
    figures = alternate(commands, runs, folder / "store")
    cells = [
        f"{figures[key].wall_s:.2f} s ({figures[key].cpu_s:.2f} s)" if key in figures else "-"
        for key in ("times", "tracecheck", "values", "pymcap-cli")
    ]
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--data", type=Path, default=HERE / "data")
    parser.add_argument("--tracecheck", help="the program tracecheck")
    parser.add_argument("--pymcap-cli", help="the program pymcap-cli")
    parser.add_argument("--only", action="append", help="one of telemetry, cameras, mixed; repeatable")
    parser.add_argument(
        "--instructions",
        action="store_true",
        help="count instructions of runs with perf, and skip the checks",
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recordings = {
            name: Contracts(BY_NAME[name].path(arguments.data), Path(folder))
            for name in arguments.only or RECORDINGS
        }
        unit = "instructions" if arguments.instructions else "CPU"
        print(f"| recording | run ({unit}) | with rate, gap, latency and stamps | with ten fields, too |")
        print("|---|---:|---:|---:|")
        for name, contracts in recordings.items():
            print_runs(name, contracts, arguments.runs, counts_instructions=arguments.instructions)
        if arguments.instructions:
            return
        print(
            "\nWall time (CPU time):\n\n| recording | check of times | tracecheck | check of ten fields | pymcap-cli |"
        )
        print("|---|---:|---:|---:|---:|")
        for name, contracts in recordings.items():
            print_checks(name, contracts, arguments.runs, arguments.tracecheck, arguments.pymcap_cli)


if __name__ == "__main__":
    main()
