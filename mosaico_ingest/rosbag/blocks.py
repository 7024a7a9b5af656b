"""Message blocks: messages read together, as one contiguous buffer plus offsets, lengths and log times."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, TypeVar

import numpy as np
from msgspec import Struct, field
from msgspec.structs import force_setattr
from numpy.typing import NDArray

from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded

__all__ = [
    "EARLIEST_NS",
    "FIRST_BYTES",
    "LATEST_NS",
    "Block",
    "Bytes",
    "Channel",
    "Encoding",
    "Loaded",
    "Part",
    "ROSHeader",
    "ROSMessage",
    "RawBatch",
    "Slab",
    "Stream",
    "UnreadableRange",
    "Want",
    "by_key",
    "in_groups",
    "in_time",
    "keep",
    "keep_each",
    "orphans",
    "pack",
    "stretches",
]

EARLIEST_NS, LATEST_NS = -(2**63), 2**63 - 1
"""The first and last time stamps there are; the last is in the year 2262."""
FIRST_BYTES, MOST_PIECES = 2 << 20, 64
"""Up to how many bytes at first, and how many chunks are read at once.

What is done once a block is done less often with larger ones; the first is small, so that the next stage begins early."""
T = TypeVar("T")


class Stream(Struct, frozen=True):
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


class Slab(Struct, frozen=True):
    """n messages inside one buffer, of one stream; every start and length has been checked against the buffer."""

    key: int
    log_times: NDArray[np.int64]
    data: NDArray[np.uint8]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    offsets: NDArray[np.int64]
    payload_bytes: int = -1
    """The sum of the lengths, which is asked for often."""

    def __post_init__(self) -> None:
        force_setattr(self, "payload_bytes", int(self.lengths.sum()))

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


class UnreadableRange(Struct, frozen=True):
    """Bytes of a recording from which messages could not be read, and why."""

    offset: int
    """File offset of the record or chunk, or the row id."""
    reason: str
    """What was expected and what is there, in one line."""
    connection: int | None = None
    """The connection the messages belong to, None if unknown: its key in the file or, once `file` is set, its id."""
    count: int | None = None
    """Number of unreadable messages; None if unknown, 0 if all of them were read in another way."""
    file: str = ""
    """The file; empty until the range becomes part of a recording."""


def orphans(counts: Mapping[int, int] | None, known: Collection[int]) -> list[UnreadableRange]:
    """Return the messages whose stream the file does not describe."""
    strangers = {key: count for key, count in (counts or {}).items() if count and key not in known}
    return [
        UnreadableRange(
            0, f"{count} messages of connection {key}, which the file does not describe", count=count
        )
        for key, count in strangers.items()
    ]


class Loaded(Struct, frozen=True):
    """What one block gave."""

    slabs: list[Slab]
    unreadable: list[UnreadableRange]


class Block(Struct, frozen=True):
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


class Want(Struct, frozen=True):
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
    unreadable: list[UnreadableRange]
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


_FEW_ROWS = 8
"""With fewer rows to a length on average, one index for every byte is cheaper than one step for every length."""
_SMALLEST_WORD, _LARGEST_WORD = 4, 64
"""Messages of many lengths are gathered in words, so that an index is needed for each word and not for each byte."""

Bytes = NDArray[np.uint8]
Longs = NDArray[np.int64]


def stretches(data: Bytes, starts: Longs, size: int) -> Bytes:
    """Return the `size` bytes from each start on, shape (len(starts), size); the caller checked the bounds."""
    windows = np.ndarray((len(data) - size + 1, size), np.uint8, data, strides=(1, 1))
    return windows[starts]


def by_key(keys: NDArray[np.integer]) -> Iterator[tuple[int, Longs]]:
    """Yield each key with the rows that have it, in their order."""
    order = np.argsort(keys, kind="stable")
    ranked = keys[order]
    edges = np.flatnonzero(np.diff(ranked)) + 1
    for rows in np.split(order, edges) if len(order) else []:
        yield int(keys[rows[0]]), rows


def keep(slab: Slab, want: Want, loaded: Loaded) -> None:
    """Add the messages within the wanted time."""
    slab = _wanted(slab, want, loaded.unreadable)
    if len(slab):
        loaded.slabs.append(slab)


def keep_each(whole: Slab, streams: Iterable[tuple[int, Longs | slice]], want: Want, loaded: Loaded) -> None:
    """Add the messages within the wanted time, stream by stream: its key, and its rows of the whole."""
    if _is_inside(whole, want):
        slabs = [whole.rows(rows, key=key) for key, rows in streams]
        loaded.slabs.extend(slab for slab in slabs if len(slab))
        return
    for key, rows in streams:
        keep(whole.rows(rows, key=key), want, loaded)


def _is_inside(slab: Slab, want: Want) -> bool:
    if not len(slab):
        return True
    first, last = int(slab.log_times.min()), int(slab.log_times.max())
    return max(want.start_ns, 0) <= first and last < want.end_ns


def _wanted(slab: Slab, want: Want, unreadable: list[UnreadableRange]) -> Slab:
    """Return the messages within the wanted time; those after 2262 are noted as lost."""
    if _is_inside(slab, want):
        return slab
    times = slab.log_times
    broken = times < 0  # unsigned in the file
    if bool(broken.any()):
        offset = int(slab.offsets[int(broken.argmax())])
        reason = f"recorded at {int(times.view(np.uint64).max())} ns, which is after the year 2262"
        unreadable.append(UnreadableRange(offset, reason, connection=slab.key, count=int(broken.sum())))
    keep_rows = ~broken & (times >= want.start_ns)
    if want.end_ns <= LATEST_NS:
        keep_rows &= times < want.end_ns
    return slab.rows(keep_rows)


def in_time(slab: Slab) -> Slab:
    """Return the messages by log time; those of the same time stay in their order."""
    times = slab.log_times
    if len(times) < 2 or bool((times[1:] >= times[:-1]).all()):  # noqa: PLR2004 - one message is in order
        return slab
    return slab.rows(np.argsort(times, kind="stable"))


def pack(slab: Slab) -> Slab:
    """Return the same messages in a buffer of their own, equal lengths side by side, or each filled up to whole words."""
    lengths = slab.lengths
    shortest, longest = int(lengths.min()), int(lengths.max())
    if shortest == longest:
        data = stretches(slab.data, slab.starts, shortest).reshape(-1)
        return _with(slab, data, np.arange(len(slab), dtype=np.int64) * shortest)
    kinds = np.unique(lengths)
    if len(kinds) * _FEW_ROWS > len(lengths):
        return _with(slab, *_gather(slab))
    starts = np.empty(len(slab), np.int64)
    pieces: list[Bytes] = []
    end = 0
    for length in kinds.tolist():
        rows = np.flatnonzero(lengths == length)
        starts[rows] = end + np.arange(len(rows), dtype=np.int64) * length
        pieces.append(stretches(slab.data, slab.starts[rows], length).reshape(-1))
        end += len(rows) * length
    return _with(slab, np.concatenate(pieces), starts)


def _with(slab: Slab, data: Bytes, starts: Longs) -> Slab:
    times, lengths, offsets = map(_own, (slab.log_times, slab.lengths, slab.offsets))
    return Slab(slab.key, times, data, starts, lengths, offsets)


def _own(values: Longs) -> Longs:
    """Return a copy of a view: messages of a rare topic wait long, and a view keeps the whole buffer alive."""
    return values if values.base is None else values.copy()


def _gather(slab: Slab) -> tuple[Bytes, Longs]:
    """Return the payloads one after the other, in whole words, and where each begins."""
    data, size = slab.data, _word_bytes(slab)
    words = -(-slab.lengths // size)
    ends = np.cumsum(words)
    starts = (ends - words) * size
    index = np.repeat(slab.starts - starts, words)
    index += np.arange(0, len(index) * size, size)
    room = len(data) - size
    index[index > room] = 0  # the last words of the last messages, see below
    out = np.ndarray(room + 1, f"V{size}", data, strides=1)[index].view(np.uint8)
    for row in np.flatnonzero(slab.starts + words * size > len(data)).tolist():
        start, length = int(slab.starts[row]), int(slab.lengths[row])
        out[starts[row] : starts[row] + length] = data[start : start + length]
    return out, starts


def _word_bytes(slab: Slab) -> int:
    """Return a power of two of which an average message has four to eight, or 1 where the buffer has not even one."""
    if len(slab.data) < _LARGEST_WORD:
        return 1
    average = slab.payload_bytes // len(slab)
    return min(max(1 << max(average.bit_length() - 3, 0), _SMALLEST_WORD), _LARGEST_WORD)


class Encoding(str, Enum):
    """How a payload is serialised."""

    CDR = "cdr"
    """ROS 2: a 4-byte encapsulation header, then aligned little- or big-endian fields."""
    ROS1 = "ros1"
    """ROS 1: packed little-endian fields."""
    OTHER = "other"
    """Not a ROS encoding (protobuf, json, …): named, never decoded."""


class Channel(Struct, frozen=True):
    """Messages of one type on one topic, written the same way; a topic may have several."""

    id: int
    """Unique within the recording, whatever its parts."""
    topic: str
    msgtype: str
    """`pkg/msg/Name`, also for ROS 1 and for old names."""
    encoding: Encoding
    count: int | None
    """How many messages the index promises; None where there is no index."""
    definition: Definition | None
    """None where no definition could be found; `problem` then says why."""
    problem: str | None = None
    latched: bool = False
    attributes: dict[str, str] = field(default_factory=dict[str, str])
    """What else the recording says: QoS profiles, caller id, md5, raw encoding name."""


class RawBatch(Struct, frozen=True):
    """n messages of one channel in log-time order, their payloads inside one buffer."""

    channel: Channel
    log_times: NDArray[np.int64]
    """When each was recorded, ns since the epoch, shape (n,)."""
    data: NDArray[np.uint8]
    """The buffer; may hold more than the payloads."""
    starts: NDArray[np.int64]
    """Where each payload begins in `data`, shape (n,)."""
    lengths: NDArray[np.int64]
    """How many bytes each payload has, shape (n,)."""
    offsets: NDArray[np.int64]
    """Where each lies in the source, for messages about it: file offset of its record or chunk, or row id; shape (n,)."""

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.log_times)

    def rows(self, choice: NDArray[np.int64] | slice) -> RawBatch:
        """Return some of the messages, over the same buffer."""
        return RawBatch(
            self.channel,
            self.log_times[choice],
            self.data,
            self.starts[choice],
            self.lengths[choice],
            self.offsets[choice],
        )

    def payload(self, row: int) -> bytes:
        """Return the bytes of one message."""
        start = int(self.starts[row])
        return self.data[start : start + int(self.lengths[row])].tobytes()


class ROSHeader(Struct, frozen=True):
    """The `std_msgs/Header` of a message."""

    stamp_ns: int
    """`stamp` in nanoseconds."""
    frame_id: str
    seq: int | None = None
    """Only ROS 1 has one."""


@dataclass(frozen=True)
class ROSMessage:
    """One message: when it was recorded, where, of which type, and its fields by name."""

    bag_timestamp_ns: int
    """When it was recorded, ns since the epoch."""
    topic: str
    msg_type: str
    """`pkg/msg/Name`."""
    data: dict[str, Any]
    """Nested messages are dictionaries, arrays are lists, `uint8[]` and its like `bytes`."""

    @property
    def timestamp_ns(self) -> int:
        """The same as `bag_timestamp_ns`."""
        return self.bag_timestamp_ns

    @property
    def header(self) -> ROSHeader | None:
        """The message's header; None where it has none, or a field of that name which is something else."""
        match self.data.get("header"):
            case {"stamp": {"sec": int(sec), "nanosec": int(nanosec)}, "frame_id": str(frame_id)} as header:
                seq = header.get("seq")
                return ROSHeader(
                    sec * 1_000_000_000 + nanosec, frame_id, seq if isinstance(seq, int) else None
                )
            case _:
                return None
