"""This file puts the blocks of several parts into one sequence by time, opening a part only when its time has come."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Generator, Iterable, Iterator

from mosaico_ingest.bag.containers.part import EARLIEST_NS, LATEST_NS, Block
from mosaico_ingest.frozen import frozen

__all__ = ["Turn", "in_turn"]


@frozen
class Turn:
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
