"""Message blocks of several files merged by time and coalesced into large batches."""

from __future__ import annotations

import heapq
import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from types import TracebackType
from typing import Generic, TypeVar

import numpy as np
from msgspec import Struct

from mosaico_ingest.rosbag.blocks import EARLIEST_NS, LATEST_NS, Block, Channel, RawBatch, Slab, in_time, pack

__all__ = [
    "Gather",
    "Prefetched",
    "Turn",
    "compact",
    "in_turn",
]

T = TypeVar("T")
_LOOK_SECONDS = 0.1


class _End(Struct, frozen=True):
    error: BaseException | None


class Prefetched(Generic[T]):
    """An iterator over `source`, of which `ahead` items are made before they are asked for.

    The source runs in one thread, which has ended when the context is left; its errors are raised here.
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
            self._items.get_nowait()  # the thread may be waiting for room
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
        except BaseException as err:  # noqa: BLE001 - the border of the thread; raised again where it is consumed
            error = err
        self._put(_End(error))

    def _put(self, item: tuple[T] | _End) -> bool:
        while not self._stop.is_set():
            try:
                self._items.put(item, timeout=_LOOK_SECONDS)
            except queue.Full:
                continue
            return True
        return False


class Turn(Struct, frozen=True):
    """One block, the part it is of, and the time no later block goes behind."""

    part: int
    block: Block
    next_ns: int


def in_turn(parts: Iterable[tuple[int | None, Callable[[], Iterator[Block]]]]) -> Generator[Turn, None, None]:
    """Yield the blocks of all parts by `start_ns`; a part is its first time and what gives its blocks."""
    heap: list[tuple[int, int, Block | None, Iterator[Block]]] = []
    for number, (start_ns, blocks) in enumerate(parts):
        first = EARLIEST_NS if start_ns is None else start_ns
        heapq.heappush(heap, (first, number, None, _late(blocks)))
    while heap:
        _, number, block, rest = heapq.heappop(heap)
        following = next(rest, None)
        if following is not None:
            heapq.heappush(heap, (following.start_ns, number, following, rest))
        if block is not None:
            yield Turn(number, block, heap[0][0] if heap else LATEST_NS)


def _late(blocks: Callable[[], Iterator[Block]]) -> Iterator[Block]:
    yield from blocks()


_FIRST_BYTES, BATCH_BYTES = 2 << 20, 8 << 20
"""A channel's first batch ends at about this many bytes of payload, each other at twice as many, up to the latter.

So the stages that follow begin while little has been read."""
_BIG_BYTES = 16 << 10
"""Messages larger than this on average are not copied: the batch points into the block they came in."""
_ROW_BYTES = 32
"""What a message costs beside its payload."""


@dataclass(slots=True)
class _Waiting:
    """What a channel has so far."""

    slabs: list[Slab] = field(default_factory=list[Slab])
    rows: int = 0
    held_bytes: int = 0
    most_bytes: int = _FIRST_BYTES

    def add(self, slab: Slab) -> None:
        self.slabs.append(slab)
        self.rows += len(slab)
        self.held_bytes += len(slab.data) + len(slab) * _ROW_BYTES


class Gather:
    """Holds messages back until there are many, or until memory is short; the fullest channel goes first."""

    def __init__(self, channels: Mapping[int, Channel], *, rows: int, memory_bytes: int) -> None:
        self._channels = channels
        self._rows = rows
        self._memory_bytes = memory_bytes
        self._waiting: dict[int, _Waiting] = {}

    def add(self, channel: int, slab: Slab, floor_ns: int) -> Iterator[RawBatch]:
        """Take `compact` messages; none that come later, these included, is older than `floor_ns`."""
        waiting = self._waiting.setdefault(channel, _Waiting())
        if waiting.slabs and self._is_full(waiting, len(slab), slab.payload_bytes):
            yield from self._flush(channel, floor_ns)
        self._waiting[channel].add(slab)

    def settle(self, floor_ns: int) -> Iterator[RawBatch]:
        """Give what should not wait: full channels, blocks held whole, and the fullest while memory is short.

        No message that comes later is older than `floor_ns`; younger ones wait, unless memory forbids.
        """
        for channel, waiting in self._waiting.items():
            if waiting.slabs and (_is_view(waiting.slabs[-1]) or self._is_full(waiting)):
                yield from self._flush(channel, floor_ns)
        while self._held() > self._memory_bytes:
            fullest = max(self._waiting, key=lambda channel: self._waiting[channel].held_bytes)
            before = self._waiting[fullest].held_bytes
            yield from self._flush(fullest, floor_ns)
            if self._waiting[fullest].held_bytes > before // 2:
                yield from self._flush(fullest, LATEST_NS)

    def rest(self) -> Iterator[RawBatch]:
        """Give everything."""
        for channel in self._waiting:
            yield from self._flush(channel, LATEST_NS)

    def _held(self) -> int:
        return sum(waiting.held_bytes for waiting in self._waiting.values())

    def _is_full(self, waiting: _Waiting, rows: int = 1, payload_bytes: int = 0) -> bool:
        return waiting.rows + rows > self._rows or waiting.held_bytes + payload_bytes > waiting.most_bytes

    def _flush(self, channel: int, floor_ns: int) -> Iterator[RawBatch]:
        """Give the messages up to `floor_ns`, keep the others."""
        before = self._waiting[channel]
        slabs = before.slabs
        waiting = self._waiting[channel] = _Waiting(most_bytes=min(2 * before.most_bytes, BATCH_BYTES))
        if slabs and not any(_is_view(slab) for slab in slabs):
            slabs = [_joined(slabs)]
        ready: list[Slab] = []
        for slab in map(in_time, slabs):
            count = int(np.searchsorted(slab.log_times, floor_ns, side="right"))
            if count:
                ready.append(slab.rows(slice(0, count)))
            if count < len(slab):
                waiting.add(slab if not count else compact(slab.rows(slice(count, None))))
        for group in _groups(_ordered(ready)):
            yield from self._batches(self._channels[channel], group)

    def _batches(self, channel: Channel, slab: Slab) -> Iterator[RawBatch]:
        """Cut into batches of the allowed size, as equal as can be."""
        parts = min(len(slab), max(-(-len(slab) // self._rows), -(-slab.payload_bytes // BATCH_BYTES)))
        for begin, end in pairwise(len(slab) * part // parts for part in range(parts + 1)):
            rows = slab.rows(slice(begin, end))
            yield RawBatch(channel, rows.log_times, rows.data, rows.starts, rows.lengths, rows.offsets)


def compact(slab: Slab) -> Slab:
    """Return the messages in a buffer of their own, unless they are too big to be worth a copy."""
    return slab if _is_view(slab) else pack(slab)


def _is_view(slab: Slab) -> bool:
    """Return whether the slab's buffer is that of the block it came in."""
    return slab.payload_bytes > _BIG_BYTES * len(slab)


def _ordered(slabs: Sequence[Slab]) -> list[Slab]:
    """Return the slabs one after the other in time; where they interleave, as one."""
    ordered = sorted(slabs, key=lambda slab: int(slab.log_times[0]))
    pairs = pairwise(ordered)
    if all(one.log_times[-1] <= other.log_times[0] for one, other in pairs):
        return ordered
    return [in_time(_joined([pack(slab) for slab in slabs]))]


def _groups(slabs: Sequence[Slab]) -> Iterator[Slab]:
    """Join neighbours, except those that are views of a block."""
    small: list[Slab] = []
    for slab in slabs:
        if _is_view(slab):
            if small:
                yield _joined(small)
                small = []
            yield slab
        else:
            small.append(slab)
    if small:
        yield _joined(small)


def _joined(slabs: Sequence[Slab]) -> Slab:
    if len(slabs) == 1:
        return slabs[0]
    bases = np.cumsum([0, *(len(slab.data) for slab in slabs[:-1])])
    return Slab(
        slabs[0].key,
        np.concatenate([slab.log_times for slab in slabs]),
        np.concatenate([slab.data for slab in slabs]),
        np.concatenate([slab.starts + base for slab, base in zip(slabs, bases.tolist(), strict=True)]),
        np.concatenate([slab.lengths for slab in slabs]),
        np.concatenate([slab.offsets for slab in slabs]),
    )
