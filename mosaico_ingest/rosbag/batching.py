"""Merge the read tasks of several splits by time, run them ahead, and coalesce small message blocks.

The steps between the container readers and `Recording.message_blocks`:

1. `merge_by_time` orders the tasks of all splits by their start time.
2. `results_in_order` runs the tasks in threads, ahead of the consumer.
3. `BlockCoalescer` joins the small blocks of each connection until they are worth decoding, sorted by log time.
"""

from __future__ import annotations

import heapq
import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from itertools import pairwise
from types import TracebackType
from typing import Generic, TypeVar

import numpy as np
from msgspec import Struct, field

from mosaico_ingest.rosbag.blocks import EARLIEST_NS, LATEST_NS, MessageBlock, ReadTask, pack, sort_by_time

T = TypeVar("T")
_STOP_POLL_SECONDS = 0.1
"""Interval in which a blocked prefetch thread checks whether it has been stopped."""
_FIRST_BYTES, BLOCK_BYTES = 2 << 20, 8 << 20
"""Target payload size of a connection's first block; it doubles with each block up to the second value.

The first block is small, so that the following stages start early."""
_VIEW_BYTES = 16 << 10
"""Blocks whose average message is larger are not copied: they remain views of the buffer that was read."""
_ROW_BYTES = 32
"""Memory per message beside its payload: log time, start, length and offset."""


class MergedTask(Struct, frozen=True):
    """A read task, the number of its split, and a lower bound for the start times of all later tasks."""

    split: int
    task: ReadTask
    next_ns: int


def merge_by_time(
    splits: Iterable[tuple[int | None, Callable[[], Iterator[ReadTask]]]],
) -> Generator[MergedTask, None, None]:
    """Yield the tasks of all splits by `start_ns`.

    Each split is its first log time (None if unknown) and a function that returns its tasks. The function is not
    called before tasks of that time are due.
    """
    heap: list[tuple[int, int, ReadTask | None, Iterator[ReadTask]]] = []
    for number, (start_ns, tasks) in enumerate(splits):
        first = EARLIEST_NS if start_ns is None else start_ns
        heapq.heappush(heap, (first, number, None, _deferred(tasks)))
    while heap:
        _, number, task, rest = heapq.heappop(heap)
        following = next(rest, None)
        if following is not None:
            heapq.heappush(heap, (following.start_ns, number, following, rest))
        if task is not None:
            yield MergedTask(number, task, heap[0][0] if heap else LATEST_NS)


def _deferred(tasks: Callable[[], Iterator[ReadTask]]) -> Iterator[ReadTask]:
    yield from tasks()


@contextmanager
def results_in_order(
    calls: Generator[Callable[[], T], None, None], *, threads: int
) -> Generator[Iterator[T], None, None]:
    """Return an iterator over the results of `calls`, in their order, while threads make the next calls.

    Another thread runs the generator. At most `max(threads, 2) + 1` results exist at a time. An exception of a call or
    of the generator is raised in place of a result. Without threads, each call is made when its result is requested.
    All threads have ended when the context is left.
    """
    if not threads:
        with closing(calls):
            yield (call() for call in calls)
        return
    pool = ThreadPoolExecutor(threads, thread_name_prefix="mosaico-read")
    try:
        with Prefetcher(_submitted(calls, pool), ahead=max(threads - 1, 1)) as futures:
            yield (future.result() for future in futures)
    finally:
        pool.shutdown(cancel_futures=True)


def _submitted(
    calls: Generator[Callable[[], T], None, None], pool: ThreadPoolExecutor
) -> Generator[Future[T], None, None]:
    with closing(calls):
        for call in calls:
            yield pool.submit(call)


class _End(Struct, frozen=True):
    error: BaseException | None


class Prefetcher(Generic[T]):
    """An iterator over `source` that computes up to `ahead` items in advance, in a thread.

    Errors of the source are raised in the consumer. The thread has ended when the context is left.
    """

    def __init__(self, source: Generator[T, None, None], *, ahead: int = 1) -> None:
        self._source = source
        self._items: queue.Queue[tuple[T] | _End] = queue.Queue(maxsize=ahead)
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work, name="mosaico-prefetch", daemon=True)

    def __enter__(self) -> Iterator[T]:
        """Start the thread and return the items."""
        self._worker.start()
        return self._consume()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the thread and wait for it."""
        self._stop.set()
        with suppress(queue.Empty):
            self._items.get_nowait()  # unblock the thread if the queue is full
        self._worker.join()

    def _consume(self) -> Iterator[T]:
        while not isinstance(item := self._items.get(), _End):
            yield item[0]
        if item.error is not None:
            raise item.error

    def _work(self) -> None:
        error: BaseException | None = None
        try:
            with closing(self._source):
                for value in self._source:
                    if not self._put((value,)):
                        return
        except BaseException as err:  # noqa: BLE001 - the consumer raises it again
            error = err
        self._put(_End(error))

    def _put(self, item: tuple[T] | _End) -> bool:
        while not self._stop.is_set():
            try:
                self._items.put(item, timeout=_STOP_POLL_SECONDS)
            except queue.Full:
                continue
            return True
        return False


class _Pending(Struct):
    """The blocks of one connection that have not been yielded yet."""

    blocks: list[MessageBlock] = field(default_factory=list[MessageBlock])
    rows: int = 0
    memory_bytes: int = 0
    target_bytes: int = _FIRST_BYTES

    def add(self, block: MessageBlock) -> None:
        self.blocks.append(block)
        self.rows += len(block)
        self.memory_bytes += len(block.data) + len(block) * _ROW_BYTES


class BlockCoalescer:
    """Joins the blocks of each connection into larger ones, sorted by log time.

    A connection is flushed when it has enough rows or bytes. If all connections together exceed the memory limit,
    the one with the most bytes is flushed first.
    """

    def __init__(self, *, max_rows: int, memory_bytes: int) -> None:
        self._max_rows = max_rows
        self._memory_bytes = memory_bytes
        self._pending: dict[int, _Pending] = {}

    def add(self, block: MessageBlock, floor_ns: int) -> Iterator[MessageBlock]:
        """Add a block that `copy_if_small` returned; no later message, including this block, is older than `floor_ns`."""
        pending = self._pending.setdefault(block.connection, _Pending())
        if pending.blocks and self._is_full(pending, len(block), block.payload_bytes):
            yield from self._flush(block.connection, floor_ns)
        self._pending[block.connection].add(block)

    def flush_ready(self, floor_ns: int) -> Iterator[MessageBlock]:
        """Yield full connections and views, and the largest connections while memory is short.

        No later message is older than `floor_ns`. Younger messages stay pending, unless memory is short.
        """
        for connection, pending in self._pending.items():
            if pending.blocks and (_is_view(pending.blocks[-1]) or self._is_full(pending)):
                yield from self._flush(connection, floor_ns)
        while sum(pending.memory_bytes for pending in self._pending.values()) > self._memory_bytes:
            largest = max(self._pending, key=lambda connection: self._pending[connection].memory_bytes)
            before = self._pending[largest].memory_bytes
            yield from self._flush(largest, floor_ns)
            if self._pending[largest].memory_bytes > before // 2:
                yield from self._flush(largest, LATEST_NS)

    def flush_all(self) -> Iterator[MessageBlock]:
        """Yield all pending messages."""
        for connection in self._pending:
            yield from self._flush(connection, LATEST_NS)

    def _is_full(self, pending: _Pending, more_rows: int = 1, more_bytes: int = 0) -> bool:
        return (
            pending.rows + more_rows > self._max_rows
            or pending.memory_bytes + more_bytes > pending.target_bytes
        )

    def _flush(self, connection: int, floor_ns: int) -> Iterator[MessageBlock]:
        """Yield the messages up to `floor_ns` in order; the others stay pending."""
        previous = self._pending[connection]
        pending = _Pending(target_bytes=min(2 * previous.target_bytes, BLOCK_BYTES))
        self._pending[connection] = pending
        blocks = previous.blocks
        if blocks and not any(_is_view(block) for block in blocks):
            blocks = [_join(blocks)]
        ready: list[MessageBlock] = []
        for block in map(sort_by_time, blocks):
            count = int(np.searchsorted(block.log_times, floor_ns, side="right"))
            if count:
                ready.append(block.rows(slice(0, count)))
            if count < len(block):
                pending.add(block if not count else copy_if_small(block.rows(slice(count, None))))
        for block in _join_small(_in_time_order(ready)):
            yield from self._split_evenly(block)

    def _split_evenly(self, block: MessageBlock) -> Iterator[MessageBlock]:
        """Yield pieces of nearly equal length that respect the row and byte limits."""
        by_rows, by_bytes = -(-len(block) // self._max_rows), -(-block.payload_bytes // BLOCK_BYTES)
        pieces = min(len(block), max(by_rows, by_bytes))
        for start, end in pairwise(len(block) * piece // pieces for piece in range(pieces + 1)):
            yield block.rows(slice(start, end))


def copy_if_small(block: MessageBlock) -> MessageBlock:
    """Return a compact copy of the block, unless its messages are so large that copying costs more than it saves."""
    return block if _is_view(block) else pack(block)


def _is_view(block: MessageBlock) -> bool:
    """Return whether the block shares the buffer that was read from the file."""
    return block.payload_bytes > _VIEW_BYTES * len(block)


def _in_time_order(blocks: Sequence[MessageBlock]) -> list[MessageBlock]:
    """Return the blocks in time order; join them into one if their time ranges overlap."""
    ordered = sorted(blocks, key=lambda block: int(block.log_times[0]))
    if all(first.log_times[-1] <= second.log_times[0] for first, second in pairwise(ordered)):
        return ordered
    return [sort_by_time(_join([pack(block) for block in blocks]))]


def _join_small(blocks: Sequence[MessageBlock]) -> Iterator[MessageBlock]:
    """Join consecutive blocks, except views."""
    small: list[MessageBlock] = []
    for block in blocks:
        if _is_view(block):
            if small:
                yield _join(small)
                small = []
            yield block
        else:
            small.append(block)
    if small:
        yield _join(small)


def _join(blocks: Sequence[MessageBlock]) -> MessageBlock:
    if len(blocks) == 1:
        return blocks[0]
    bases = np.cumsum([0, *(len(block.data) for block in blocks[:-1])])
    has_publish_times = any(block.publish_times is not None for block in blocks)
    return MessageBlock(
        blocks[0].connection,
        np.concatenate([block.log_times for block in blocks]),
        np.concatenate([block.data for block in blocks]),
        np.concatenate([block.starts + base for block, base in zip(blocks, bases.tolist(), strict=True)]),
        np.concatenate([block.lengths for block in blocks]),
        np.concatenate([block.offsets for block in blocks]),
        np.concatenate(
            [block.log_times if block.publish_times is None else block.publish_times for block in blocks]
        )
        if has_publish_times
        else None,
        np.concatenate(
            [
                np.zeros(len(block), np.int64) if block.sequences is None else block.sequences
                for block in blocks
            ]
        )
        if any(block.sequences is not None for block in blocks)
        else None,
    )
