"""A recording: one or several files as one set of connections, with their findings."""

from __future__ import annotations

import re
import weakref
from collections import defaultdict
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType

import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from typing_extensions import Self

from mosaico_ingest.errors import BagError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.batching import Gather, Prefetched, Turn, compact, in_turn
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
    Block,
    Channel,
    Encoding,
    Loaded,
    Part,
    RawBatch,
    Slab,
    Stream,
    UnreadableRange,
    Want,
)
from mosaico_ingest.rosbag.compression import inflate_messages
from mosaico_ingest.rosbag.definitions.hashes import definition_difference
from mosaico_ingest.rosbag.definitions.model import (
    Definition,
    Embedded,
    Resolver,
    Source,
    normalize_msgtype,
)
from mosaico_ingest.rosbag.discovery import Found, Metadata, TopicHint, discover
from mosaico_ingest.rosbag.opening import open_part

__all__ = [
    "ChannelTable",
    "Recording",
    "compare",
    "open_recording",
    "span",
    "windows",
]


def compare(
    parts: Sequence[Part],
    channels: Sequence[Channel],
    unreadable: Sequence[UnreadableRange],
    metadata: Metadata | None,
) -> tuple[Finding, ...]:
    """Return what a reader of this recording should know, most of it harmless."""
    hints = _metadata(channels, metadata) if metadata else ()
    return (*_parts(parts), *_unreadable(unreadable), *_channels(channels), *hints)


def _parts(parts: Sequence[Part]) -> Iterator[Finding]:
    for part in parts:
        for note in part.notes:
            yield Finding("container-note", Severity.INFO, f"{part.path}: {note}")


def _unreadable(unreadable: Sequence[UnreadableRange]) -> Iterator[Finding]:
    for item in unreadable:
        yield Finding(
            "unreadable-range",
            Severity.WARNING,
            f"{item.file}: at {item.offset}: {item.reason}",
        )


def _channels(channels: Sequence[Channel]) -> Iterator[Finding]:
    types: dict[str, set[str]] = defaultdict(set)
    for channel in channels:
        types[channel.topic].add(channel.msgtype)
        if channel.encoding is Encoding.OTHER:
            yield Finding(
                "skipped-encoding", Severity.WARNING, f"{channel.topic} is skipped: {channel.problem}"
            )
    for topic, names in types.items():
        if len(names) > 1:
            listed = ", ".join(sorted(names))
            yield Finding(
                "mixed-types", Severity.WARNING, f"{topic} has messages of {len(names)} types: {listed}"
            )


def _metadata(channels: Sequence[Channel], metadata: Metadata) -> Iterator[Finding]:
    stored: dict[str, list[Channel]] = defaultdict(list)
    for channel in channels:
        stored[channel.topic].append(channel)
    for hint in metadata.topics:
        for difference in _differences(hint, stored.pop(hint.topic, [])):
            yield _differs(metadata, f"{hint.topic}: {difference}")
    for topic, found in stored.items():
        if any(channel.count != 0 for channel in found):
            yield _differs(metadata, f"{topic} is not in the metadata")


def _differences(hint: TopicHint, channels: Sequence[Channel]) -> Iterator[str]:
    if not channels:
        if hint.count:
            yield f"{hint.count} messages in the metadata, no such topic in the storage"
        return
    names = {channel.msgtype for channel in channels}
    if {name.replace("/msg/", "/") for name in names} != {hint.msgtype.replace("/msg/", "/")}:
        yield f"type {hint.msgtype} in the metadata, {', '.join(sorted(names))} in the storage"
    counts = [channel.count for channel in channels]
    total = sum(count or 0 for count in counts)
    if None not in counts and total != hint.count:
        yield f"{hint.count} messages in the metadata, {total} in the storage"
    first = channels[0].attributes
    if hint.qos and first.get("offered_qos_profiles", hint.qos).strip() != hint.qos.strip():
        yield "the QoS in the metadata is not that in the storage"
    encoding = first.get("encoding", "")
    if hint.serialization_format and encoding and hint.serialization_format != encoding:
        yield f"serialisation {hint.serialization_format} in the metadata, {encoding} in the storage"


def _differs(metadata: Metadata, difference: str) -> Finding:
    return Finding(
        "metadata-differs",
        Severity.INFO,
        f"{metadata.path}: {difference}",
        help="the storage decides what is read",
    )


@dataclass(slots=True)
class _Types:
    """Asks the resolver once for each type and text."""

    resolver: Resolver
    known: dict[tuple[str, Embedded | None, int], Definition | str] = field(
        default_factory=dict[tuple[str, "Embedded | None", int], "Definition | str"]
    )

    def of(self, stream: Stream) -> Definition | str:
        """Return the stream's definition, or why there is none."""
        if stream.encoding is Encoding.OTHER:
            return (
                f"its messages are {stream.attributes.get('encoding', '')!r}, which is no ROS serialisation"
            )
        asked = (stream.msgtype, stream.embedded, stream.ros_version)
        if asked not in self.known:
            self.known[asked] = self._resolve(stream)
        found = self.known[asked]
        if isinstance(found, str) or found.source in {Source.BAG, Source.CUSTOM}:
            return found
        other = definition_difference(found, stream.attributes)
        remedy = "give the right one with custom_msgs"
        return f"another definition of {found.root} is known: {other} — {remedy}" if other else found

    def _resolve(self, stream: Stream) -> Definition | str:
        try:
            return self.resolver.resolve(stream.msgtype, stream.embedded, ros_version=stream.ros_version)
        except BagError as err:
            return str(err)


class ChannelTable:
    """The channels of a recording, and which streams of which part they are made of."""

    def __init__(self, parts: Sequence[Part], resolver: Resolver) -> None:
        self._ids: dict[tuple[int, int], int] = {}
        self._found: list[Channel] = []
        self._of_topic: dict[str, list[int]] = defaultdict(list)
        types = _Types(resolver)
        for number, part in enumerate(parts):
            for stream in part.streams:
                self._ids[number, stream.key] = self._place(_channel(stream, types.of(stream)))
        self.channels: tuple[Channel, ...] = tuple(self._found)

    def channel_id(self, part: int, key: int) -> int:
        """Return the channel that a part's stream belongs to."""
        return self._ids[part, key]

    def keys(self, part: int, channels: Collection[int]) -> frozenset[int]:
        """Return the streams of a part that make up the channels."""
        return frozenset(
            key for (number, key), channel in self._ids.items() if number == part and channel in channels
        )

    def _place(self, channel: Channel) -> int:
        """Add to the channel that is written the same way, or open a new one."""
        for known in (self._found[number] for number in self._of_topic[channel.topic]):
            if _same(known, channel):
                count = None if known.count is None or channel.count is None else known.count + channel.count
                latched = known.latched or channel.latched
                self._found[known.id] = replace(known, count=count, latched=latched)
                return known.id
        self._of_topic[channel.topic].append(len(self._found))
        self._found.append(replace(channel, id=len(self._found)))
        return len(self._found) - 1


def _channel(stream: Stream, definition: Definition | str) -> Channel:
    is_known = isinstance(definition, Definition)
    return Channel(
        id=-1,
        topic=stream.topic,
        msgtype=definition.root if isinstance(definition, Definition) else normalize_msgtype(stream.msgtype),
        encoding=stream.encoding,
        count=stream.count,
        definition=definition if isinstance(definition, Definition) else None,
        problem=None if is_known else str(definition),
        latched=stream.latched or _is_transient_local(stream),
        attributes=stream.attributes,
    )


def _is_transient_local(stream: Stream) -> bool:
    """Return whether late subscribers get old messages too: what ROS 1 called latched."""
    return (
        re.search(r"durability:\s*(1|transient_local)\b", stream.attributes.get("offered_qos_profiles", ""))
        is not None
    )


def _same(one: Channel, other: Channel) -> bool:
    """Return whether two are written the same way; comments in a definition make no difference."""
    if (one.topic, one.msgtype, one.encoding, one.problem) != (
        other.topic,
        other.msgtype,
        other.encoding,
        other.problem,
    ):
        return False
    a, b = one.definition, other.definition
    if a is None or b is None:
        return a is b
    return a is b or (a.ros_version == b.ros_version and a.types == b.types)


_SMALL_BYTES = 1 << 20
"""A recording up to this is read in less time than a thread takes to start."""
_THREADS = 3
"""Reading ahead is the third, beside decoding and writing: with fewer processors they are in each other's way."""
_BLOCKS = 4
"""As many blocks fit into the memory, or twice as many where one is read while another is at work."""

ROWS = 1 << 16
MEMORY_BYTES = 64 << 20


def open_recording(paths: AnyPath | Sequence[AnyPath], *, resolve: Resolver) -> Recording:
    """Open a recording: a file, a directory, a `metadata.yaml`, or several of them as one.

    Raises:
        BagError: A path does not exist, is empty, is no recording, or is damaged beyond reading.
    """
    found = discover([paths] if isinstance(paths, Path | RemotePath) else list(paths))
    stack = ExitStack()
    try:
        parts, unreadable = _open_parts(found.files, stack)
        return Recording(parts, unreadable, found, resolve, stack)
    except BaseException:
        stack.close()
        raise


def _open_parts(files: Sequence[AnyPath], stack: ExitStack) -> tuple[list[Part], list[UnreadableRange]]:
    """Open every file; one of several that cannot be opened is a item, as a recorder that crashed leaves such."""
    parts: list[Part] = []
    failed: list[BagError] = []
    for file in files:
        try:
            parts.append(open_part(file, stack))
        except BagError as err:  # noqa: PERF203 - each file may fail for itself
            failed.append(err)
    if not parts:
        raise _none_opened(failed)
    kinds = sorted({part.container for part in parts})
    if len(kinds) > 1:
        raise BagError(
            f"the parts of one recording are of different formats: {', '.join(kinds)}",
            where=str(files[0].parent),
            hint="name the files of one format",
        )
    return parts, [
        UnreadableRange(0, f"this part cannot be opened: {err.what}", file=err.where or "") for err in failed
    ]


def _none_opened(failed: Sequence[BagError]) -> BagError:
    first = failed[0]
    if len(failed) == 1:
        return first
    what = f"{first.what}; nor can any of the {len(failed) - 1} other parts be opened"
    return BagError(what, where=first.where, hint=first.hint)


class _Step(Struct, frozen=True):
    """What one block gave, ready to be gathered."""

    part: int
    slabs: list[Slab]
    unreadable: list[UnreadableRange]
    start_ns: int
    next_ns: int


class Recording:
    """What is in a recording, and its messages in batches; a context manager, usable at once."""

    def __init__(
        self,
        parts: Sequence[Part],
        unreadable: Sequence[UnreadableRange],
        found: Found,
        resolver: Resolver,
        stack: ExitStack,
    ) -> None:
        self._parts = parts
        self._stack = stack
        self._table = ChannelTable(parts, resolver)
        self._running: weakref.WeakSet[Generator[RawBatch, None, None]] = weakref.WeakSet()
        self._unreadable: dict[UnreadableRange, None] = dict.fromkeys(unreadable)
        self.files: tuple[AnyPath, ...] = found.files
        self.missing: tuple[AnyPath, ...] = found.missing
        """Parts that are not there, though the metadata list them; they are among the unreadable too."""
        self.container: str = parts[0].container
        """`mcap`, `sqlite3` or `ros1`."""
        self.size_bytes: int = sum(file.stat().st_size for file in found.files)
        self.channels: tuple[Channel, ...] = self._table.channels
        self.start_ns: int | None = min((p.start_ns for p in parts if p.start_ns is not None), default=None)
        self.end_ns: int | None = max((p.end_ns for p in parts if p.end_ns is not None), default=None)
        """The last message's time, inclusive."""
        counts = [part.message_count for part in parts]
        self.message_count: int | None = None if None in counts else sum(count or 0 for count in counts)
        for number, part in enumerate(parts):
            self._note(number, part.unreadable)
        oddities = compare(parts, self.channels, self.unreadable, found.metadata)
        self._unreadable |= dict.fromkeys(
            UnreadableRange(0, "this part is not there", file=str(file)) for file in found.missing
        )
        self.findings: tuple[Finding, ...] = (*found.findings, *oddities)
        """What to know before reading; what reading itself finds broken is in `unreadable`."""

    def __enter__(self) -> Self:
        """Return the recording."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Stop what is being read, close the files and remove temporary ones; twice does no harm."""
        for running in list(self._running):
            running.close()
        self._stack.close()

    @property
    def unreadable(self) -> tuple[UnreadableRange, ...]:
        """What could not be read: found when opening, and by every iteration so far."""
        return tuple(self._unreadable)

    def batches(
        self,
        channel_ids: Collection[int] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        rows: int = ROWS,
        memory_bytes: int = MEMORY_BYTES,
    ) -> Iterator[RawBatch]:
        """Yield the messages of some channels (None: all) from `start_ns` up to, not including, `end_ns`.

        The batches of a channel follow each other in log time, unless its messages are so much out of order that
        sorting them would take more than about `memory_bytes`. A batch has at most `rows` messages.
        What cannot be read is left out and listed in `unreadable`.
        """
        ids = (
            frozenset(channel.id for channel in self.channels)
            if channel_ids is None
            else frozenset(channel_ids)
        )
        low = EARLIEST_NS if start_ns is None else start_ns
        high = LATEST_NS + 1 if end_ns is None else end_ns
        ahead = self.size_bytes > _SMALL_BYTES and pa.cpu_count() >= _THREADS
        block_bytes = memory_bytes // (2 * _BLOCKS if ahead else _BLOCKS)
        wants = [
            Want(self._table.keys(number, ids), low, high, block_bytes) for number in range(len(self._parts))
        ]
        gather = Gather(
            {channel.id: channel for channel in self.channels}, rows=rows, memory_bytes=memory_bytes
        )
        running = self._gathered(wants, gather, ahead=ahead)
        self._running.add(running)
        return running

    def _gathered(
        self, wants: Sequence[Want], gather: Gather, *, ahead: bool
    ) -> Generator[RawBatch, None, None]:
        blocks = self._steps(wants)
        with Prefetched(blocks) if ahead else closing(blocks) as steps:
            for step in steps:
                self._note(step.part, step.unreadable)
                for slab in step.slabs:
                    yield from gather.add(self._table.channel_id(step.part, slab.key), slab, step.start_ns)
                yield from gather.settle(step.next_ns)
            yield from gather.rest()

    def _steps(self, wants: Sequence[Want]) -> Generator[_Step, None, None]:
        """Load block after block; runs in a thread of its own where that pays."""
        sources = [
            (part.start_ns, partial(_blocks, part, want))
            for part, want in zip(self._parts, wants, strict=True)
            if want.keys
        ]
        numbers = [number for number, want in enumerate(wants) if want.keys]
        for turn in in_turn(sources):
            yield self._step(numbers[turn.part], turn)
        for number in numbers:
            self._parts[number].check_unchanged()

    def _step(self, number: int, turn: Turn) -> _Step:
        try:
            loaded = turn.block.load()
        except BagError as err:
            return _Step(number, [], [UnreadableRange(0, err.what)], turn.block.start_ns, turn.next_ns)
        slabs = [self._plain(number, slab, loaded.unreadable) for slab in loaded.slabs]
        compacted = [compact(slab) for slab in slabs if len(slab)]
        return _Step(number, compacted, loaded.unreadable, turn.block.start_ns, turn.next_ns)

    def _plain(self, number: int, slab: Slab, unreadable: list[UnreadableRange]) -> Slab:
        channel = self.channels[self._table.channel_id(number, slab.key)]
        return inflate_messages(slab, unreadable) if channel.encoding is Encoding.CDR else slab

    def _note(self, number: int, unreadable: Sequence[UnreadableRange]) -> None:
        """Add ranges of a file to those of the recording."""
        file = str(self._parts[number].path)
        for item in unreadable:
            connection = None if item.connection is None else self._table.channel_id(number, item.connection)
            self._unreadable[replace(item, connection=connection, file=file)] = None


def _blocks(part: Part, want: Want) -> Iterator[Block]:
    """Yield the blocks of a part; where it can tell of no more, that is a item and not the end of the recording."""
    try:
        yield from part.blocks(want)
    except BagError as err:
        item = UnreadableRange(0, err.what)
        yield Block(LATEST_NS, lambda: Loaded([], [item]))


_USUAL_BYTES = 32 << 20
_MAX_BYTES = 256 << 20
_MAX_PIECES = 10_000


def span(recording: Recording) -> tuple[int, int]:
    """Return the log times of the first and the last message; without an index the recording is read for them."""
    if recording.start_ns is not None and recording.end_ns is not None:
        return recording.start_ns, recording.end_ns
    times = [(int(batch.log_times.min()), int(batch.log_times.max())) for batch in recording.batches()]
    return min((low for low, _ in times), default=0), max((high for _, high in times), default=0)


def windows(
    recording: Recording, channel_ids: Collection[int], *, max_bytes: int = _MAX_BYTES
) -> Iterator[list[RawBatch]]:
    """Yield all batches of each stretch of time, in order; one with more than `max_bytes` is halved.

    The first and the last stretch are open: an index may be wrong about the ends.
    """
    first, last = span(recording)
    step = max((last - first) // min(recording.size_bytes // _USUAL_BYTES + 1, _MAX_PIECES) + 1, 1)
    inner = range(first + step, last + 1, step)
    waiting = list(zip((None, *inner), (*inner, None), strict=True))[::-1]
    while waiting:
        low, high = waiting.pop()
        start, end = first if low is None else low, last + 1 if high is None else high
        batches = _read(recording, channel_ids, low, high, max_bytes if end - start > 1 else None)
        if batches is None:
            middle = start + (end - start) // 2
            waiting += [(middle, high), (low, middle)]
        else:
            yield batches


def _read(
    recording: Recording,
    channel_ids: Collection[int],
    low: int | None,
    high: int | None,
    max_bytes: int | None,
) -> list[RawBatch] | None:
    """Return the batches of a stretch, None where they are more than `max_bytes`."""
    found, size = list[RawBatch](), 0
    for batch in recording.batches(channel_ids, start_ns=low, end_ns=high):
        found.append(batch)
        size += int(batch.lengths.sum())
        if max_bytes is not None and size > max_bytes:
            return None
    return found
