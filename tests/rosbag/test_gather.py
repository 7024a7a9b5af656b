"""Packing, sorting, merging and reading ahead give what doing it one by one gives."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from itertools import pairwise
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.rosbag.batching import Gather, Prefetched, in_turn
from mosaico_ingest.rosbag.blocks import (
    FIRST_BYTES,
    LATEST_NS,
    Block,
    Channel,
    Encoding,
    Loaded,
    Slab,
    by_key,
    in_groups,
    in_time,
    pack,
)

CHANNEL = Channel(0, "/t", "pkg/msg/T", Encoding.CDR, None, None)

Row = tuple[int, bytes]


def slab_of(rows: list[Row], *, gap: int = 3) -> Slab:
    """Return messages with `gap` foreign bytes between them."""
    data, starts = bytearray(), list[int]()
    for _, payload in rows:
        data += b"?" * gap
        starts.append(len(data))
        data += payload
    return Slab(
        0,
        np.array([time for time, _ in rows], np.int64),
        np.frombuffer(bytes(data), np.uint8),
        np.array(starts, np.int64),
        np.array([len(payload) for _, payload in rows], np.int64),
        np.arange(len(rows), dtype=np.int64),
    )


def rows_of(slab: Slab) -> list[Row]:
    """Return the messages one by one: the slow twin of everything here."""
    spans = zip(slab.starts.tolist(), slab.lengths.tolist(), strict=True)
    payloads = [slab.data[start : start + length].tobytes() for start, length in spans]
    return list(zip(slab.log_times.tolist(), payloads, strict=True))


ROWS = st.lists(st.tuples(st.integers(0, 50), st.binary(max_size=12)), min_size=1, max_size=60)


@given(ROWS)
def test_packing_keeps_every_message_and_little_else(rows: list[Row]) -> None:
    packed = pack(slab_of(rows))
    assert rows_of(packed) == rows
    assert len(packed.data) <= sum(len(payload) + 3 for _, payload in rows)


@pytest.mark.parametrize("lengths", [[4] * 1000, [*range(1000)]], ids=["equal", "random"])
def test_what_is_packed_holds_nothing_of_the_block_it_came_in(lengths: list[int]) -> None:
    """A rare topic waits long for company; were its times views of the block's, every block would stay in memory."""
    whole = slab_of([(number, b"x" * length) for number, length in enumerate(lengths)])
    for part in (pack(whole.rows(slice(1, 3))), pack(whole.rows(np.array([1, 2])))):
        held = [part.log_times, part.data, part.starts, part.lengths, part.offsets]
        owners = [values if values.base is None else values.base for values in held]
        assert all(
            isinstance(owner, np.ndarray) and owner.size <= max(2, sum(lengths[1:3]) + 6) for owner in owners
        )


@given(st.lists(st.integers(0, 700), min_size=1, max_size=60), st.randoms(use_true_random=False))
def test_packing_many_lengths_in_words_keeps_every_byte(lengths: list[int], random: Random) -> None:
    rows = [(number, random.randbytes(length)) for number, length in enumerate(lengths)]
    packed = pack(slab_of(rows, gap=0))
    assert rows_of(packed) == rows
    assert len(packed.data) <= sum(lengths) + len(rows) * max(4, min(64, sum(lengths) // len(rows) // 4))


@given(ROWS)
def test_sorting_is_stable(rows: list[Row]) -> None:
    assert rows_of(in_time(slab_of(rows))) == sorted(rows, key=lambda row: row[0])


@given(st.lists(st.integers(0, 5)))
def test_rows_by_key_keep_their_order(keys: list[int]) -> None:
    found = {key: rows.tolist() for key, rows in by_key(np.array(keys, np.int64))}
    assert found == {key: [n for n, other in enumerate(keys) if other == key] for key in set(keys)}


@given(st.lists(ROWS, min_size=1, max_size=8), st.integers(1, 40), st.integers(1, 4000))
def test_gathering_gives_every_message_once_in_batches_of_the_asked_size(
    blocks: list[list[Row]], rows: int, memory_bytes: int
) -> None:
    blocks = sorted(blocks, key=lambda block: min(time for time, _ in block))
    floors = [min(time for time, _ in block) for block in blocks] + [LATEST_NS]
    gather = Gather({0: CHANNEL}, rows=rows, memory_bytes=memory_bytes)
    batches = []
    for block, (floor_ns, next_ns) in zip(blocks, pairwise(floors), strict=True):
        batches += gather.add(0, pack(slab_of(block)), floor_ns)
        batches += gather.settle(next_ns)
    batches += gather.rest()
    found = [(int(time), batch.payload(n)) for batch in batches for n, time in enumerate(batch.log_times)]
    assert sorted(found) == sorted(row for block in blocks for row in block)
    assert all(0 < len(batch) <= rows for batch in batches)


@given(st.lists(ROWS, min_size=1, max_size=8), st.integers(1, 40))
def test_with_memory_to_spare_batches_follow_in_time(blocks: list[list[Row]], rows: int) -> None:
    blocks = sorted(blocks, key=lambda block: min(time for time, _ in block))
    floors = [min(time for time, _ in block) for block in blocks] + [LATEST_NS]
    gather = Gather({0: CHANNEL}, rows=rows, memory_bytes=1 << 30)
    times: list[int] = []
    for block, (floor_ns, next_ns) in zip(blocks, pairwise(floors), strict=True):
        for batch in [*gather.add(0, pack(slab_of(block)), floor_ns), *gather.settle(next_ns)]:
            times += batch.log_times.tolist()
    times += [time for batch in gather.rest() for time in batch.log_times.tolist()]
    assert times == sorted(times)


def test_a_part_is_not_opened_before_its_time_has_come() -> None:
    opened: list[str] = []

    def part(name: str, *starts: int) -> Iterator[Block]:
        opened.append(name)
        for start in starts:
            yield Block(start, lambda: Loaded([], []))

    turns = in_turn(
        [(0, lambda: part("a", 0, 5, 20)), (10, lambda: part("b", 10, 30)), (None, lambda: part("c"))]
    )
    first = next(turns)
    assert (first.part, first.next_ns) == (0, 5)
    assert opened == ["c", "a"]
    assert [(turn.part, turn.block.start_ns, turn.next_ns) for turn in turns] == [
        (0, 5, 10),
        (1, 10, 20),
        (0, 20, 30),
        (1, 30, LATEST_NS),
    ]


def test_reading_ahead_gives_the_same_items_and_the_error_at_its_place() -> None:
    def source() -> Generator[int, None, None]:
        yield from range(10)
        raise ValueError("here")

    found: list[int] = []
    with Prefetched(source()) as items, pytest.raises(ValueError, match="here"):
        found.extend(items)
    assert found == list(range(10))


def test_reading_ahead_stops_with_its_context() -> None:
    made: list[int] = []

    def source() -> Generator[int, None, None]:
        try:
            while True:
                made.append(1)
                yield 1
        finally:
            made.append(0)

    before = threading.active_count()
    with Prefetched(source(), ahead=2) as items:
        next(items)
    assert threading.active_count() == before
    assert len(made) <= 6
    assert made[-1] == 0


def test_groups_double_up_to_a_block_and_give_what_came_before_an_error() -> None:
    def pieces() -> Generator[int, None, None]:
        yield from [FIRST_BYTES] * 8
        raise ValueError("here")

    found: list[int] = []
    with pytest.raises(ValueError, match="here"):
        found.extend(len(group) for group in in_groups(pieces(), int, 4 * FIRST_BYTES))
    assert found == [1, 2, 4, 1]
    assert [len(group) for group in in_groups([1] * 5, int, 0)] == [1] * 5
    assert [len(group) for group in in_groups([1] * 5, int, FIRST_BYTES, most=2)] == [2, 2, 1]
