"""Every damaged `.db3` file is read completely, or the loss is reported.

The messages of the intact file are the oracle, and `PRAGMA integrity_check` decides whether damage can be detected: values
that changed in place leave a valid file, so the number of messages is the same, but not their content.
"""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag import sqlite
from mosaico_ingest.rosbag.recording import open_recording

PAGE_BYTES = 4096


Messages = list[tuple[str, int, bytes]]


class Intact(NamedTuple):
    """A file without faults, its messages, and a time range that excludes some of them."""

    content: bytes
    messages: Messages
    start_ns: int
    end_ns: int


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory, recordings: Any) -> Intact:
    """A database with several levels of pages, overflow pages and 910 messages."""
    messages = recordings.sent(900)
    large = [message._replace(topic="/large", payload=message.payload * 30) for message in messages[::90]]
    everything = sorted([*messages, *large], key=lambda message: message.time_ns)
    folder = recordings.rosbag2(tmp_path_factory.mktemp("intact") / "bag", everything, storage="sqlite3")
    content = next(folder.glob("*.db3")).read_bytes()
    return Intact(content, compared(everything), everything[200].time_ns, everything[700].time_ns)


def compared(messages: Iterable[Any]) -> Messages:
    return sorted((message.topic, message.time_ns, message.payload) for message in messages)


def mutate(content: bytes, rng: random.Random) -> tuple[str, bytes]:
    """Return a copy of the file with one fault, and a description of the fault."""
    data = bytearray(content)
    offset = rng.randrange(len(data))
    if rng.random() < 0.5:  # the heads of pages, where most structure is
        offset = offset // PAGE_BYTES * PAGE_BYTES + rng.randrange(64)
    kind = rng.choice(["flip", "flip", "flip", "byte", "word", "remove", "insert", "zeros", "cut", "page"])
    match kind:
        case "flip":
            data[offset] ^= 1 << rng.randrange(8)
        case "byte":
            data[offset] = rng.randrange(256)
        case "word":
            data[offset : offset + 4] = rng.randbytes(4)
        case "remove":
            del data[offset : offset + rng.choice([1, 2, 100])]
        case "insert":
            data[offset:offset] = rng.randbytes(rng.choice([1, 2, 100]))
        case "zeros":
            size = rng.choice([16, 512, PAGE_BYTES])
            data[offset : offset + size] = bytes(size)
        case "cut":
            del data[offset:]
        case _:
            first, second = (rng.randrange(len(data) // PAGE_BYTES) * PAGE_BYTES for _ in range(2))
            data[first : first + PAGE_BYTES] = content[second : second + PAGE_BYTES]
    return f"{kind} at {offset}", bytes(data)


def is_valid(path: Path) -> bool:
    """Return whether SQLite finds no damage."""
    database = sqlite3.connect(f"{path.as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        return bool(database.execute("PRAGMA integrity_check").fetchone() == ("ok",))
    except (sqlite3.Error, UnicodeDecodeError):
        return False
    finally:
        database.close()


def check(path: Path, recordings: Any, fault: str, expected: Messages, **selection: int) -> None:
    """Read a damaged file; fail if messages are missing, repeated or different without an unreadable range."""
    try:
        with open_recording(path, resolve=recordings.blind) as recording:
            topics = {connection.id: connection.topic for connection in recording.connections}
            read = sorted(
                (topics[block.connection], int(time_ns), block.payload(row))
                for block in recording.message_blocks(**selection)
                for row, time_ns in enumerate(block.log_times)
            )
            losses = [item.count for item in recording.unreadable if item.count != 0]
    except BagError:
        return
    if not losses and is_valid(path):
        assert selection or len(read) == len(expected), f"{fault}: {len(read)} of {len(expected)} messages"
    elif not losses:
        assert read == expected, f"{fault}: {len(read)} of {len(expected)} messages, and no unreadable range"
    if not selection and recording.message_count is not None and None not in losses:
        total = len(read) + sum(loss or 0 for loss in losses)
        assert recording.message_count == total, f"{fault}: {recording.message_count} != {total}"


def run(tmp_path: Path, recordings: Any, intact: Intact, seeds: Iterable[int]) -> None:
    path = tmp_path / "damaged.db3"
    start_ns, end_ns = intact.start_ns, intact.end_ns
    selected = [message for message in intact.messages if start_ns <= message[1] < end_ns]
    for seed in seeds:
        fault, content = mutate(intact.content, random.Random(seed))  # noqa: S311 - test data
        path.write_bytes(content)
        check(path, recordings, f"seed {seed}: {fault}", intact.messages)
        check(path, recordings, f"seed {seed}: {fault}", selected, start_ns=start_ns, end_ns=end_ns)


def test_sqlite_read_repeatedly_is_checked_once(
    recordings: Any, intact: Intact, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks: list[str] = []

    def check(database: sqlite3.Connection, name: str) -> str | None:
        checks.append(name)
        return original(database, name)

    original = sqlite._check
    monkeypatch.setattr(sqlite, "_check", check)
    path = tmp_path / "intact.db3"
    path.write_bytes(intact.content)
    with open_recording(path, resolve=recordings.blind) as recording:
        counts = [sum(map(len, recording.message_blocks())) for _ in range(3)]
    assert counts == [len(intact.messages)] * 3
    assert checks == ["integrity_check"]


def test_sqlite_one_fault_is_read_or_reported(tmp_path: Path, recordings: Any, intact: Intact) -> None:
    run(tmp_path, recordings, intact, [*range(100), 158, 234])


@pytest.mark.slow
def test_sqlite_thousands_of_faults_are_read_or_reported(
    tmp_path: Path, recordings: Any, intact: Intact
) -> None:
    run(tmp_path, recordings, intact, range(100, 4000))
