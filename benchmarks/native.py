"""Comparison with Rerun's converter in Rust and with a plain copy, in alternating runs; `./dev bench --native` calls it."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from measure import Sample, run, typical

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

HEAD = (
    "| recording | this project | CPU | Rerun | CPU | copy + sync | floor | peer | / Rerun | / copy | stored | Rerun's file |"
    "\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
)
_OWN_COMPONENTS = ("Mcap", "RecordingInfo", "rosbag2")
"""Prefixes of components that describe the recording, not its messages."""


@dataclass
class Contest:
    """The samples of one recording; the floor and the official injector are measured in seconds for the same recording."""

    recording: Path
    ours: list[Sample] = field(default_factory=list[Sample])
    native: list[Sample] = field(default_factory=list[Sample])
    copy: list[Sample] = field(default_factory=list[Sample])
    floor_s: list[float] = field(default_factory=list[float])
    peer_s: float | None = None
    stored_bytes: int = 0
    native_bytes: int = 0
    components: tuple[str, ...] = ()
    """The components that Rerun stores, such as `Points3D:positions`."""

    def record(self) -> dict[str, object]:
        """Return the medians for the JSON file."""
        ours, native, copy = map(typical, (self.ours, self.native, self.copy))
        return {
            "recording": self.recording.name,
            "wall_s": ours.wall_s,
            "cpu_s": ours.cpu_s,
            "rerun_wall_s": native.wall_s,
            "rerun_cpu_s": native.cpu_s,
            "copy_wall_s": copy.wall_s,
            "floor_s": median(self.floor_s),
            "peer_s": self.peer_s,
            "stored_bytes": self.stored_bytes,
            "rerun_bytes": self.native_bytes,
            "rerun_components": self.components,
        }


def compare(
    recording: Path,
    command: Sequence[str | Path],
    rerun: Path,
    *,
    runs: int,
    folder: Path,
    floor_seconds: Callable[[Path, Path], float],
) -> Contest:
    """Ingest, convert and copy a recording in turn; each program ends with its data on the disk."""
    contest = Contest(recording)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        store, target, copy = (Path(temporary) / name for name in ("store", "run.rrd", "copy"))
        for _ in range(runs):
            shutil.rmtree(store, ignore_errors=True)
            for path in (target, copy):
                path.unlink(missing_ok=True)
            contest.copy.append(_shell('cp "$0" "$1" && sync "$1"', recording, copy))
            contest.native.append(
                _shell('"$2" mcap convert "$0" -o "$1" && sync "$1"', recording, target, rerun)
            )
            contest.ours.append(run([*command, "bag", recording, "--name", "run", "--store", store, "-q"]))
            contest.floor_s.append(floor_seconds(recording, store))
        contest.stored_bytes = sum(file.stat().st_size for file in store.rglob("*.parquet"))
        contest.native_bytes = target.stat().st_size
        contest.components = _components(run([rerun, "rrd", "stats", target]).output)
    return contest


def _shell(script: str, *arguments: Path) -> Sample:
    return run(["sh", "-c", script, *arguments])


def _components(statistics: str) -> tuple[str, ...]:
    """Return the components in the output of `rerun rrd stats`."""
    _, _, section = statistics.partition("Num chunks per component\n")
    lines = section.partition("\n\n")[0].splitlines()[1:]
    names = (line.rpartition(": ")[0] for line in lines)
    return tuple(name for name in names if not name.startswith(_OWN_COMPONENTS))


def print_contest(contest: Contest) -> None:
    """Print a row of the table."""
    ours, native, copy = map(typical, (contest.ours, contest.native, contest.copy))
    peer = "-" if contest.peer_s is None else f"{contest.peer_s:.1f} s"
    print(
        f"| {contest.recording.stem} | {ours.wall_s:.2f} s | {ours.cpu_s:.2f} s | {native.wall_s:.2f} s "
        f"| {native.cpu_s:.2f} s | {copy.wall_s:.2f} s | {median(contest.floor_s):.2f} s | {peer} "
        f"| {ours.wall_s / native.wall_s:.2f}x | {ours.wall_s / copy.wall_s:.1f}x "
        f"| {contest.stored_bytes / 1e6:.0f} MB | {contest.native_bytes / 1e6:.0f} MB |",
        flush=True,
    )


def print_differences(contests: Sequence[Contest]) -> None:
    """Print the components that Rerun stores for each recording."""
    print(
        "\nBoth programs have synced their output when they end. This project stores every field of a topic as a column, "
        "with checksums.\nRerun stores its own components and has other columns:"
    )
    for contest in contests:
        print(f"- {contest.recording.stem}: {', '.join(contest.components)}")


def write_contests(contests: Sequence[Contest], path: Path) -> None:
    """Write the figures as JSON."""
    path.write_text(json.dumps([contest.record() for contest in contests], indent=1) + "\n")
