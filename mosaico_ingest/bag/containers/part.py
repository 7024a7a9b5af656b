"""This file is what every container gives: the streams of one file, and their messages block by block."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.definition import Embedded
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath

__all__ = [
    "EARLIEST_NS",
    "FIRST_BYTES",
    "LATEST_NS",
    "Block",
    "Hole",
    "Loaded",
    "Part",
    "Slab",
    "Stream",
    "Want",
    "in_groups",
    "orphans",
]

EARLIEST_NS, LATEST_NS = -(2**63), 2**63 - 1
"""The first and last time stamps there are; the last is in the year 2262."""
FIRST_BYTES, MOST_PIECES = 2 << 20, 64
"""Up to how many bytes at first, and how many chunks are read at once.

What is done once a block is done less often with larger ones; the first is small, so that the next stage begins early."""
T = TypeVar("T")


@frozen
class Stream:
    """One connection as its file describes it."""

    key: int
    """Unique within the part."""
    topic: str
    msgtype: str
    """As the file spells it."""
    encoding: Encoding
    ros_version: int
    embedded: Embedded | None
    count: int | None
    """How many messages the index promises."""
    latched: bool = False
    attributes: dict[str, str] = field(default_factory=dict[str, str])


@frozen
class Slab:
    """n messages inside one buffer, of one stream; every start and length has been checked against the buffer."""

    key: int
    log_times: NDArray[np.int64]
    data: NDArray[np.uint8]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    offsets: NDArray[np.int64]
    payload_bytes: int = field(init=False)
    """The sum of the lengths, which is asked for often."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "payload_bytes", int(self.lengths.sum()))

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.log_times)

    def rows(self, choice: NDArray[np.int64] | NDArray[np.bool_] | slice, *, key: int | None = None) -> Slab:
        """Return some of the messages, over the same buffer; `key` names their stream where this slab has several."""
        return Slab(
            self.key if key is None else key,
            self.log_times[choice],
            self.data,
            self.starts[choice],
            self.lengths[choice],
            self.offsets[choice],
        )


@frozen
class Hole:
    """What could not be read of one file: `bag.batch.Loss` before streams have become channels."""

    offset: int
    reason: str
    key: int | None = None
    count: int | None = None


def orphans(counts: Mapping[int, int] | None, known: Collection[int]) -> list[Hole]:
    """Return the messages whose stream the file does not describe."""
    strangers = {key: count for key, count in (counts or {}).items() if count and key not in known}
    return [
        Hole(0, f"{count} messages of connection {key}, which the file does not describe", count=count)
        for key, count in strangers.items()
    ]


@frozen
class Loaded:
    """What one block gave."""

    slabs: list[Slab]
    holes: list[Hole]


@frozen
class Block:
    """A piece of a file that is read at once; none of its messages is older than `start_ns`."""

    start_ns: int
    load: Callable[[], Loaded]


def in_groups(
    pieces: Iterable[T], size: Callable[[T], int], block_bytes: int, *, most: int = MOST_PIECES
) -> Iterator[list[T]]:
    """Yield neighbours together, up to `most`; of bytes few at first, then twice as many each time, up to `block_bytes`.

    What came before an error of `pieces` is given before it is raised.
    """
    group: list[T] = []
    held_bytes, most_bytes = 0, min(FIRST_BYTES, block_bytes)
    try:
        for piece in pieces:
            piece_bytes = size(piece)
            held_bytes += piece_bytes
            if group and (held_bytes > most_bytes or len(group) == most):
                yield group
                group, held_bytes = [], piece_bytes
                most_bytes = min(2 * most_bytes, block_bytes)
            group.append(piece)
    except Exception:
        if group:
            yield group
        raise
    if group:
        yield group


@frozen
class Want:
    """Which messages to read: streams by key, and times from `start_ns` up to, not including, `end_ns`."""

    keys: Collection[int]
    start_ns: int
    end_ns: int
    block_bytes: int
    """About how many bytes to read at once."""

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """Return whether anything between the two times, both inclusive, may be wanted."""
        return first_ns < self.end_ns and last_ns >= self.start_ns


class Part(Protocol):
    """One open file of a recording."""

    path: AnyPath
    """The file as it was named, not a copy that had to be made."""
    container: str
    streams: tuple[Stream, ...]
    message_count: int | None
    """How many messages the index promises."""
    start_ns: int | None
    end_ns: int | None
    """The last message's time, inclusive."""
    holes: list[Hole]
    """What was found broken while opening."""
    notes: list[str]
    """What else is worth saying about the file, one line each."""

    def blocks(self, want: Want) -> Iterator[Block]:
        """Yield what holds wanted messages, by ascending `start_ns`."""
        ...

    def check_unchanged(self) -> None:
        """Raise where the file has changed since it was opened; called once all of it was read."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...
