"""Every damaged `.db3` file is read completely, or the loss is reported: the intact file is the oracle."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.recording import open_recording

PAGE_BYTES = 4096


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory, recordings: Any) -> tuple[bytes, int]:
    """A database with several levels of pages, overflow pages and 900 messages, and their number."""
    messages = recordings.sent(900)
    large = [message._replace(topic="/large", payload=message.payload * 30) for message in messages[::90]]
    everything = sorted([*messages, *large], key=lambda message: message.time_ns)
    folder = recordings.rosbag2(tmp_path_factory.mktemp("intact") / "bag", everything, storage="sqlite3")
    return next(folder.glob("*.db3")).read_bytes(), len(everything)


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


def faults(intact: tuple[bytes, int], seeds: range) -> Iterator[tuple[str, bytes]]:
    for seed in seeds:
        fault, content = mutate(intact[0], random.Random(seed))  # noqa: S311 - test data
        yield f"seed {seed}: {fault}", content


def check(path: Path, recordings: Any, fault: str, count: int) -> None:
    """Read a damaged file; fail if messages are missing or repeated without an unreadable range."""
    try:
        with open_recording(path, resolve=recordings.blind) as recording:
            read = sum(len(block) for block in recording.message_blocks())
            losses = [item.count for item in recording.unreadable if item.count != 0]
    except BagError:
        return
    assert read == count or losses, f"{fault}: {read} of {count} messages, and no unreadable range"
    if recording.message_count is not None and None not in losses:
        total = read + sum(loss or 0 for loss in losses)
        assert recording.message_count == total, f"{fault}: {recording.message_count} != {total}"


def run(tmp_path: Path, recordings: Any, intact: tuple[bytes, int], seeds: range) -> None:
    path = tmp_path / "damaged.db3"
    for fault, content in faults(intact, seeds):
        path.write_bytes(content)
        check(path, recordings, fault, intact[1])


def test_sqlite_one_fault_is_read_or_reported(
    tmp_path: Path, recordings: Any, intact: tuple[bytes, int]
) -> None:
    run(tmp_path, recordings, intact, range(150))


@pytest.mark.slow
def test_sqlite_thousands_of_faults_are_read_or_reported(
    tmp_path: Path, recordings: Any, intact: tuple[bytes, int]
) -> None:
    run(tmp_path, recordings, intact, range(150, 4000))
