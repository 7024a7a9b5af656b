"""Packing, sorting, merging, prefetching and coalescing return the same messages as processing them one by one."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterator, Sequence
from functools import partial
from itertools import pairwise
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.rosbag.batching import BlockCoalescer, Prefetcher, merge_by_time, results_in_order
from mosaico_ingest.rosbag.blocks import (
    FIRST_GROUP_BYTES,
    LATEST_NS,
    MessageBlock,
    ReadResult,
    ReadTask,
    fixed_slices,
    group_by_bytes,
    pack,
    rows_by_connection,
    sort_by_time,
)

Row = tuple[int, bytes]


def block_of(rows: list[Row], *, gap: int = 3) -> MessageBlock:
    """Return messages with `gap` other bytes between them."""
    data, starts = bytearray(), list[int]()
    for _, payload in rows:
        data += b"?" * gap
        starts.append(len(data))
        data += payload
    return MessageBlock(
        0,
        np.array([time for time, _ in rows], np.int64),
        np.frombuffer(bytes(data), np.uint8),
        np.array(starts, np.int64),
        np.array([len(payload) for _, payload in rows], np.int64),
        np.arange(len(rows), dtype=np.int64),
    )


def rows_of(block: MessageBlock) -> list[Row]:
    """Return the messages one by one."""
    spans = zip(block.starts.tolist(), block.lengths.tolist(), strict=True)
    payloads = [block.data[start : start + length].tobytes() for start, length in spans]
    return list(zip(block.log_times.tolist(), payloads, strict=True))


ROWS = st.lists(st.tuples(st.integers(0, 50), st.binary(max_size=12)), min_size=1, max_size=60)


@pytest.mark.parametrize("size", [0, 1, 31, 4096, 4097, 6000])
@pytest.mark.parametrize("starts", [[], [0], [5999, 0, 17, 17, 6000], range(0, 6000, 7)])
def test_fixed_slices_any_size_equal_slices_of_the_bytes(size: int, starts: Sequence[int]) -> None:
    data = np.random.default_rng(size).integers(0, 256, 12_000, np.uint8)

    slices = fixed_slices(data, np.array(starts, np.int64), size)

    assert slices.shape == (len(starts), size)
    assert slices.tobytes() == b"".join(data[start : start + size].tobytes() for start in starts)
    assert not np.shares_memory(slices, data)


@given(ROWS)
def test_pack_any_lengths_keeps_every_message_without_gaps(rows: list[Row]) -> None:
    packed = pack(block_of(rows))
    assert rows_of(packed) == rows
    assert len(packed.data) <= sum(len(payload) + 3 for _, payload in rows)


@pytest.mark.parametrize("lengths", [[4] * 1000, [*range(1000)]], ids=["equal", "random"])
def test_pack_rows_of_large_block_keeps_no_reference_to_its_buffers(lengths: list[int]) -> None:
    """Messages of a rare topic stay pending for long; a view would keep the complete buffer in memory."""
    whole = block_of([(number, b"x" * length) for number, length in enumerate(lengths)])
    for part in (pack(whole.rows(slice(1, 3))), pack(whole.rows(np.array([1, 2])))):
        contents = [part.log_times, part.data, part.starts, part.lengths, part.offsets]
        owners = [values if values.base is None else values.base for values in contents]
        assert all(
            isinstance(owner, np.ndarray) and owner.size <= max(2, sum(lengths[1:3]) + 6) for owner in owners
        )


@given(st.lists(st.integers(0, 700), min_size=1, max_size=60), st.randoms(use_true_random=False))
def test_pack_many_lengths_keeps_every_byte_with_word_padding(lengths: list[int], random: Random) -> None:
    rows = [(number, random.randbytes(length)) for number, length in enumerate(lengths)]
    packed = pack(block_of(rows, gap=0))
    assert rows_of(packed) == rows
    assert len(packed.data) <= sum(lengths) + len(rows) * max(4, min(64, sum(lengths) // len(rows) // 4))


@given(ROWS)
def test_sort_by_time_equal_times_keep_their_order(rows: list[Row]) -> None:
    assert rows_of(sort_by_time(block_of(rows))) == sorted(rows, key=lambda row: row[0])


@given(st.lists(st.integers(0, 5)))
def test_rows_by_connection_keeps_order_of_rows(keys: list[int]) -> None:
    actual = {key: rows.tolist() for key, rows in rows_by_connection(np.array(keys, np.int64))}
    assert actual == {key: [n for n, other in enumerate(keys) if other == key] for key in set(keys)}


@given(st.lists(ROWS, min_size=1, max_size=8), st.integers(1, 40), st.integers(1, 4000))
def test_coalescer_little_memory_yields_every_message_once_within_row_limit(
    blocks: list[list[Row]], rows: int, memory_bytes: int
) -> None:
    blocks = sorted(blocks, key=lambda block: min(time for time, _ in block))
    floors = [min(time for time, _ in block) for block in blocks] + [LATEST_NS]
    coalescer = BlockCoalescer(max_rows=rows, memory_bytes=memory_bytes)
    batches = []
    for block, (floor_ns, next_ns) in zip(blocks, pairwise(floors), strict=True):
        batches += coalescer.add(pack(block_of(block)), floor_ns)
        batches += coalescer.flush_ready(next_ns)
    batches += coalescer.flush_all()
    actual = [(int(time), batch.payload(n)) for batch in batches for n, time in enumerate(batch.log_times)]
    assert sorted(actual) == sorted(row for block in blocks for row in block)
    assert all(0 < len(batch) <= rows for batch in batches)


@given(st.lists(ROWS, min_size=1, max_size=8), st.integers(1, 40))
def test_coalescer_enough_memory_yields_blocks_in_time_order(blocks: list[list[Row]], rows: int) -> None:
    blocks = sorted(blocks, key=lambda block: min(time for time, _ in block))
    floors = [min(time for time, _ in block) for block in blocks] + [LATEST_NS]
    coalescer = BlockCoalescer(max_rows=rows, memory_bytes=1 << 30)
    times: list[int] = []
    for block, (floor_ns, next_ns) in zip(blocks, pairwise(floors), strict=True):
        for batch in [*coalescer.add(pack(block_of(block)), floor_ns), *coalescer.flush_ready(next_ns)]:
            times += batch.log_times.tolist()
    times += [time for batch in coalescer.flush_all() for time in batch.log_times.tolist()]
    assert times == sorted(times)


def test_merge_by_time_split_is_not_opened_before_its_start_time() -> None:
    opened: list[str] = []

    def split(name: str, *starts: int) -> Iterator[ReadTask]:
        opened.append(name)
        for start in starts:
            yield ReadTask(start, lambda: ReadResult([], []))

    tasks = merge_by_time(
        [(0, lambda: split("a", 0, 5, 20)), (10, lambda: split("b", 10, 30)), (None, lambda: split("c"))]
    )
    first = next(tasks)
    assert (first.split, first.next_ns) == (0, 5)
    assert opened == ["c", "a"]
    assert [(merged.split, merged.task.start_ns, merged.next_ns) for merged in tasks] == [
        (0, 5, 10),
        (1, 10, 20),
        (0, 20, 30),
        (1, 30, LATEST_NS),
    ]


def test_prefetcher_failing_source_yields_items_then_raises() -> None:
    def source() -> Generator[int, None, None]:
        yield from range(10)
        raise ValueError("here")

    actual: list[int] = []
    with Prefetcher(source()) as items, pytest.raises(ValueError, match="here"):
        actual.extend(items)
    assert actual == list(range(10))


def test_prefetcher_context_exit_stops_thread() -> None:
    result: list[int] = []

    def source() -> Generator[int, None, None]:
        try:
            while True:
                result.append(1)
                yield 1
        finally:
            result.append(0)

    before = threading.active_count()
    with Prefetcher(source(), ahead=2) as items:
        next(items)
    assert threading.active_count() == before
    assert len(result) <= 6
    assert result[-1] == 0


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_results_in_order_slow_calls_keep_their_order_and_errors(threads: int) -> None:
    def call(number: int) -> int:
        time.sleep(0.002 if number % 3 else 0.005)
        if number == 8:
            raise ValueError("here")
        return number

    before = threading.active_count()
    actual: list[int] = []
    calls = (partial(call, number) for number in range(20))
    with pytest.raises(ValueError, match="here"), results_in_order(calls, threads=threads) as results:
        actual.extend(results)
    assert actual == list(range(8))
    assert threading.active_count() == before


@pytest.mark.parametrize(("threads", "most"), [(0, 0), (1, 3), (3, 4)])
def test_results_in_order_limits_the_results_that_wait(threads: int, most: int) -> None:
    started: list[int] = []
    calls = (partial(started.append, number) for number in range(50))
    with results_in_order(calls, threads=threads) as results:
        for taken, _ in enumerate(results, 1):
            time.sleep(0.001)
            assert len(started) - taken <= most


def test_group_by_bytes_failing_iterator_yields_doubling_groups_then_raises() -> None:
    def pieces() -> Generator[int, None, None]:
        yield from [FIRST_GROUP_BYTES] * 8
        raise ValueError("here")

    actual: list[int] = []
    with pytest.raises(ValueError, match="here"):
        actual.extend(len(group) for group in group_by_bytes(pieces(), int, 4 * FIRST_GROUP_BYTES))
    assert actual == [1, 2, 4, 1]
    assert [len(group) for group in group_by_bytes([1] * 5, int, 0)] == [1] * 5
    assert [len(group) for group in group_by_bytes([1] * 5, int, FIRST_GROUP_BYTES, max_length=2)] == [
        2,
        2,
        1,
    ]
