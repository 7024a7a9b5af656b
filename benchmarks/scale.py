"""Measure inputs of unusual proportions: CPU time, peak memory and the number of stored rows.

    ./dev bench scale            10^6 messages on a topic, 5,000 topics, 10,000 splits, 50 GB by range,
                                 10^5 sequences and recordings
    ./dev bench scale --small    a hundredth of that, as in the tests

Each case fails if a message is missing.
"""

from __future__ import annotations

import argparse
import os
import struct
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from measure import Sample, run
from sparse import recording, served

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.values import Stores
from mosaico_ingest.report.run import read_report
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.mcap.writer import McapWriter

INGEST = (sys.executable, "-m", "mosaico_ingest")
START_NS = 1_700_000_000_000_000_000
REPORT = "report.jsonl"
SMALL = 100
"""The divisor of `--small`."""
MAX_SENT_BYTES = 1 << 20
"""Maximum number of bytes that ingesting one topic of the sparse recording may read."""


@dataclass(frozen=True)
class Figures:
    """The figures of one case."""

    name: str
    rows: int
    sample: Sample


def number() -> Definition:
    """Return the definition of a message with one number."""
    embedded = Embedded("ros2msg", "float64 data")
    return TypeResolver(Stores.EMPTY).resolve("made/msg/Number", embedded, ros_version=2)


def write(path: Path, topics: int, messages: int, start: int = 0) -> None:
    """Write messages with consecutive log times, one after the other to each topic."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = McapWriter(path)
    channels = [writer.add_connection(f"/topic_{topic:05}", number()) for topic in range(topics)]
    for step in range(messages):
        payload = b"\x00\x01\x00\x00" + struct.pack("<d", start + step)
        for channel in channels:
            writer.write(channel, START_NS + (start + step) * 1000, payload)
    writer.finish()


def ingest(folder: Path, path: str, expected: int, name: str, *options: str, settings: str = "") -> Figures:
    """Ingest the recordings of a pattern, and check the number of stored rows."""
    job, report = folder / "job.yaml", folder / REPORT
    job.write_text(
        f'version: 1\nbag: {{path: "{path}"}}\nsequence: {{name: "{{stem}}", if_exists: skip}}\n'
        f"target: {{store: store}}\n{settings}"
    )
    sample = run([*INGEST, "run", job, "--quiet", "--report", report, *options])
    rows = read_report(report).summary.written
    assert rows == expected, f"{name}: {rows} of {expected} rows"
    return Figures(name, rows, sample)


def one_topic(folder: Path, divisor: int) -> Figures:
    """Ingest one topic with 10^6 messages."""
    count = 1_000_000 // divisor
    write(folder / "drive.mcap", 1, count)
    return ingest(folder, "drive.mcap", count, f"1 topic x {count:,} messages")


def many_topics(folder: Path, divisor: int) -> Figures:
    """Ingest 5,000 topics with ten messages each."""
    count = 5_000 // divisor
    write(folder / "drive.mcap", count, 10)
    return ingest(folder, "drive.mcap", count * 10, f"{count:,} topics x 10 messages")


def many_splits(folder: Path, divisor: int) -> Figures:
    """Ingest one recording of 10,000 splits with one message each."""
    count = 10_000 // divisor
    for split in range(count):
        write(folder / f"drive/drive_{split}.mcap", 1, 1, start=split)
    return ingest(folder, "drive", count, f"{count:,} splits x 1 message")


def sparse_recording(folder: Path, divisor: int) -> Figures:
    """Ingest one topic of a recording of 50 GB behind a URL, whose other topic has all bytes but a few."""
    chunks = 100 if divisor == 1 else 10
    file = recording(chunks, 500_000_000 * 100 // divisor // chunks)
    with served(file) as url:
        name = f"{file.size / 1e9:.1f} GB by range, 1 topic"
        figures = ingest(folder, url, chunks, name, settings="topics: [/small]\n")
    assert file.sent_bytes < MAX_SENT_BYTES, f"{name}: {file.sent_bytes:,} bytes were read"
    print(f"{name}: {file.sent_bytes:,} bytes were read", file=sys.stderr)
    return figures


def many_sequences(folder: Path, divisor: int) -> Figures:
    """List the last page of a store of 10^5 sequences."""
    count = 100_000 // divisor
    store = Store.open(folder / "store")
    with store.catalog.write(lasting=False) as db:  # pyright: ignore[reportAttributeAccessIssue] - a store on a disk
        db.executemany(
            "INSERT INTO sequences (name, metadata, created_ns) VALUES (?, '{}', 1)",
            [(f"s{number:06}",) for number in range(count)],
        )
    last = f"s{count - 11:06}"
    listing = ["store", "ls", "--store", str(folder / "store"), "--after", last, "--limit", "100", "--json"]
    sample = run([*INGEST, *listing])
    rows = sample.output.count('"name"')
    assert rows == 10, sample.output
    return Figures(f"last page of {count:,} sequences", rows, sample)


def many_recordings(folder: Path, divisor: int) -> Figures:
    """Ingest 100,000 recordings with a streamed report, then skip them, since they are stored."""
    count = 100_000 if divisor == 1 else 200
    (folder / "recordings").mkdir()
    for position in range(count):
        name = folder / f"recordings/{position:06}.mcap"
        if position % 10_000:  # file systems limit the number of links to a file
            os.link(folder / "recordings" / f"{position - position % 10_000:06}.mcap", name)
        else:
            write(name, 1, 1)
    start = datetime.now(timezone.utc)
    stored = ingest(folder, "recordings/*", count, f"{count:,} recordings", "--jobs", "2")
    print(line(stored), flush=True)
    first_s = (read_report(folder / REPORT).recordings[0].started_at - start).total_seconds()
    print(f"the first recording started after {first_s:.2f} s", file=sys.stderr)
    return ingest(folder, "recordings/*", 0, f"{count:,} known recordings")


CASES: tuple[Callable[[Path, int], Figures], ...] = (
    one_topic,
    many_topics,
    many_splits,
    sparse_recording,
    many_sequences,
    many_recordings,
)


def line(figures: Figures) -> str:
    """Return a row of the table."""
    sample = figures.sample
    return f"| {figures.name} | {figures.rows:,} | {sample.cpu_s:.2f} s | {sample.peak_bytes >> 20} MiB |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--small", action="store_true", help="measure a hundredth of each case")
    parser.add_argument("--case", choices=[case.__name__ for case in CASES], help="measure one case")
    arguments = parser.parse_args()
    print("| case | rows | CPU time | peak memory |\n|---|---:|---:|---:|")
    for case in CASES:
        if arguments.case in {None, case.__name__}:
            with tempfile.TemporaryDirectory() as folder:
                figures = case(Path(folder), SMALL if arguments.small else 1)
            print(line(figures), flush=True)


if __name__ == "__main__":
    main()
