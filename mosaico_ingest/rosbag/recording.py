"""A recording: one or several files as one set of connections, and its messages as blocks in time order."""

from __future__ import annotations

import re
import weakref
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from typing_extensions import Self

from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.batching import (
    BlockCoalescer,
    MergedTask,
    copy_if_small,
    merge_by_time,
    results_in_order,
)
from mosaico_ingest.rosbag.blocks import (
    EARLIEST_NS,
    LATEST_NS,
    ROSBAG2_ENTRY,
    ROSBAG2_RECORD,
    Attachment,
    ChunkChecksum,
    Connection,
    Encoding,
    HasAttachments,
    HasMetadataRecords,
    Int64s,
    MessageBlock,
    ReadRequest,
    ReadResult,
    ReadTask,
    SplitConnection,
    SplitReader,
    UnreadableRange,
)
from mosaico_ingest.rosbag.compression import CHUNK_LIMIT_KEY, MAX_CHUNK_BYTES, decompress_messages
from mosaico_ingest.rosbag.definitions.linking import definition_difference
from mosaico_ingest.rosbag.definitions.model import (
    Definition,
    Embedded,
    Language,
    Resolver,
    Source,
    normalize_msgtype,
)
from mosaico_ingest.rosbag.discovery import (
    Metadata,
    MetadataTopic,
    RecordingFiles,
    add_missing_messages,
    discover,
    listed_counts,
    may_have_custom_data,
    missing_after_reading,
    open_split,
    parse_metadata,
)
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS, MessageEncoding, refusal

BlockObserver: TypeAlias = Callable[[int, int, MessageBlock], None]
"""Receives the number of a split, the id of a connection, and messages over the buffer that was read."""
DAMAGE_HELP = "copy the file again, or restore it from a backup"
_SMALL_RECORDING_BYTES = 1 << 20
"""Up to this size, reading the recording takes less time than starting a prefetch thread."""
_MAX_READERS = 3
"""Maximum number of threads that read and decompress; decoding and writing use one thread each."""
_BLOCKS_IN_MEMORY = _MAX_READERS + 1
"""The memory limit divided by the size of one read; it must not depend on the number of threads, because the size of
reads determines the row groups in the store."""
_MAX_ROWS = 1 << 16
_MEMORY_BYTES = 64 << 20
_SLICE_BYTES, _MAX_SLICE_BYTES, _MAX_SLICES = 32 << 20, 256 << 20, 10_000
"""Target and maximum payload size of a time slice, and the maximum number of slices before halving."""


def open_recording(
    paths: AnyPath | Sequence[AnyPath], *, resolve: Resolver, max_chunk_bytes: int = MAX_CHUNK_BYTES
) -> Recording:
    """Open a recording: a file, a directory, a `metadata.yaml`, or several splits.

    Chunks that declare a decompressed size of more than `max_chunk_bytes` become unreadable ranges.

    Raises:
        BagError: A path does not exist, or no file of the recording can be opened.
    """
    files = discover([paths] if isinstance(paths, Path | RemotePath) else list(paths))
    stack = ExitStack()
    try:
        splits, unreadable = _open_splits(files.files, stack, max_chunk_bytes)
        return Recording(splits, unreadable, files, resolve, stack)
    except BaseException:
        stack.close()
        raise


def _open_splits(
    files: Sequence[AnyPath], stack: ExitStack, max_chunk_bytes: int
) -> tuple[list[SplitReader], list[UnreadableRange]]:
    """Open all splits. A crashed recorder leaves damaged splits, so those become unreadable ranges if others open."""
    splits: list[SplitReader] = []
    errors: list[BagError] = []
    for file in files:
        try:
            splits.append(open_split(file, stack, max_chunk_bytes=max_chunk_bytes))
        except BagError as err:  # noqa: PERF203 - each split may fail independently
            errors.append(err)
    if not splits:
        first = errors[0]
        if len(errors) == 1:
            raise first
        what = f"{first.what}; the other {len(errors) - 1} splits cannot be opened either"
        raise BagError(what, where=first.where, hint=first.hint)
    containers = sorted({split.container for split in splits})
    if len(containers) > 1:
        raise BagError(
            f"the splits have different formats: {', '.join(containers)}",
            where=str(files[0].parent),
            hint="name only files of one format",
        )
    return splits, [
        UnreadableRange(0, f"this split cannot be opened: {err.what}", file=err.where or "") for err in errors
    ]


class Recording:
    """A recording's connections, its findings, and its messages as blocks. A context manager."""

    def __init__(
        self,
        splits: Sequence[SplitReader],
        unreadable: Sequence[UnreadableRange],
        files: RecordingFiles,
        resolver: Resolver,
        stack: ExitStack,
    ) -> None:
        self._splits = splits
        self._stack = stack
        self._table = ConnectionTable(splits, resolver)
        self._iterators: weakref.WeakSet[Generator[MessageBlock, None, None]] = weakref.WeakSet()
        self._unreadable: dict[UnreadableRange, None] = dict.fromkeys(unreadable)
        self.files: tuple[AnyPath, ...] = files.files
        self.is_remote: bool = any(isinstance(file, RemotePath) for file in files.files)
        """Whether a file is behind a URL, where reading the times of a message index takes one request per chunk."""
        self.metadata: Metadata | None = files.metadata
        """The content of the recording's `metadata.yaml`."""
        self.missing_files: tuple[AnyPath, ...] = files.missing
        """Splits that the metadata lists and that do not exist; each is an unreadable range as well."""
        self.container: str = splits[0].container
        """`mcap`, `sqlite3` or `ros1`."""
        self.size_bytes: int = sum(file.stat().st_size for file in files.files)
        self._listed = {} if unreadable else listed_counts(files)
        self._metadata_path = "" if files.metadata is None else str(files.metadata.path)
        gaps = [gap for split in splits for gap in split.unreadable]
        self.connections, missing = add_missing_messages(
            self._table.connections, self._listed, gaps, file=self._metadata_path
        )
        self.start_ns: int | None = min((s.start_ns for s in splits if s.start_ns is not None), default=None)
        self.end_ns: int | None = max((s.end_ns for s in splits if s.end_ns is not None), default=None)
        """Log time of the last message, inclusive."""
        counts = [split.message_count for split in splits]
        self.message_count: int | None = None if None in counts else sum(count or 0 for count in counts)
        if self.message_count is not None:
            self.message_count += sum(gap.count or 0 for gap in missing)
        for number, split in enumerate(splits):
            self._report(number, split.unreadable)
        self._unreadable |= dict.fromkeys(missing)
        self._infer_definitions()
        findings = recording_findings(splits, self.connections, self.unreadable, files.metadata)
        self._unreadable |= dict.fromkeys(
            UnreadableRange(0, "this split does not exist", file=str(file)) for file in files.missing
        )
        self.findings: tuple[Finding, ...] = (*files.findings, *findings)
        """Findings from opening the recording; damage found while reading is in `unreadable` only."""

    def _infer_definitions(self) -> None:
        """Complete the definitions of JSON connections whose schemas declare no properties, by reading all messages."""
        connections = list(self.connections)
        for connection in connections:
            definition = connection.definition
            if (
                definition is None
                or definition.language is not Language.JSON_SCHEMA
                or definition.shape is not None
            ):
                continue
            from mosaico_ingest.rosbag.encodings.json_messages import infer_definition  # noqa: PLC0415 - rarely needed

            inferred = infer_definition(definition, self.message_blocks([connection.id]))
            connections[connection.id] = replace(connection, definition=inferred)
        self.connections = tuple(connections)

    def __enter__(self) -> Self:
        """Return the recording."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the recording."""
        self.close()

    def close(self) -> None:
        """Stop all iterations, close the files and remove temporary copies. Closing twice is harmless."""
        for iterator in list(self._iterators):
            iterator.close()
        self._stack.close()

    @property
    def chunk_checksums(self) -> Counter[ChunkChecksum] | None:
        """The number of chunks that were read, by their checksum; None if the format has no checksums of chunks."""
        by_split = [getattr(split, "chunk_checksums", None) for split in self._splits]
        if None in by_split:
            return None
        return Counter(checksum for chunks in by_split if chunks for checksum in chunks.values())

    @property
    def unreadable(self) -> tuple[UnreadableRange, ...]:
        """The ranges that could not be read: found while opening the files, and by every iteration so far."""
        return tuple(self._unreadable)

    def metadata_records(self) -> dict[str, dict[str, str]]:
        """Return the entries of the metadata records by name; later splits take precedence.

        Raises:
            BagError: The file cannot be read.
        """
        records: dict[str, dict[str, str]] = {}
        for split in self._splits:
            for name, entries in (
                split.metadata_records().items() if isinstance(split, HasMetadataRecords) else ()
            ):
                records.setdefault(name, {}).update(entries)
        return records

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments of all splits, without their content."""
        return tuple(
            replace(attachment, split=number)
            for number, split in enumerate(self._splits)
            for attachment in (split.attachments() if isinstance(split, HasAttachments) else ())
        )

    def attachment_chunks(self, attachment: Attachment) -> Iterator[bytes]:
        """Yield the content of an attachment.

        Raises:
            BagError: The content cannot be read, or differs from its checksum; raised after the last chunk.
        """
        split = self._splits[attachment.split]
        if isinstance(split, HasAttachments):
            yield from split.attachment_chunks(attachment)

    def custom_data(self) -> dict[str, str]:
        """Return the `custom_data` of rosbag2, from `metadata.yaml` or else from the copy in the files.

        Raises:
            BagError: The file cannot be read.
        """
        if self.metadata is not None:
            return dict(self.metadata.custom_data)
        text = self.metadata_records().get(ROSBAG2_RECORD, {}).get(ROSBAG2_ENTRY)
        if text is None or not may_have_custom_data(text):
            return {}
        with suppress(BagError):
            return dict(parse_metadata(text, self.files[0], is_embedded=True).custom_data)
        return {}

    def message_blocks(
        self,
        connection_ids: Collection[int] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        max_rows: int = _MAX_ROWS,
        memory_bytes: int = _MEMORY_BYTES,
        observe: BlockObserver | None = None,
    ) -> Iterator[MessageBlock]:
        """Yield the messages of some connections (default: all) with start_ns <= log time < end_ns.

        The blocks of a connection are in log-time order, unless sorting its messages would take more than about
        `memory_bytes`. A block has at most `max_rows` messages. Unreadable ranges are skipped and added to
        `unreadable`. `observe` receives the messages before they are sorted, in several threads.
        """
        ids = frozenset(range(len(self.connections))) if connection_ids is None else frozenset(connection_ids)
        first = EARLIEST_NS if start_ns is None else start_ns
        end = LATEST_NS + 1 if end_ns is None else end_ns
        requests = {
            number: ReadRequest(keys, first, end, memory_bytes // _BLOCKS_IN_MEMORY, max_rows)
            for number in range(len(self._splits))
            if (keys := self._table.split_connections(number, ids))
        }
        coalescer = BlockCoalescer(max_rows=max_rows, memory_bytes=memory_bytes)
        is_unlimited = first <= EARLIEST_NS and end > LATEST_NS
        counts = dict.fromkeys(ids, 0) if is_unlimited else None
        iterator = self._coalesced(requests, coalescer, observe, counts)
        self._iterators.add(iterator)
        return iterator

    def index_times(
        self, connection_ids: Collection[int], *, start_ns: int | None = None, end_ns: int | None = None
    ) -> dict[int, Int64s] | None:
        """Return the log times of some connections with start_ns <= log time < end_ns, sorted, without their messages.

        The times are those of the index, so messages that cannot be read count, too. None if a file has no index, or if
        its index contradicts itself: the number of times differs from the number of messages of the connection.
        """
        parts: dict[int, list[Int64s]] = {key: [] for key in connection_ids}
        for number, split in enumerate(self._splits):
            keys = self._table.split_connections(number, connection_ids)
            read_times = getattr(split, "index_times", None)
            times = read_times(keys) if read_times is not None else None
            if times is None:
                return None
            for key, arrays in times.items():
                parts[self._table.connection_id(number, key)] += arrays
        counts = {one.id: one.count for one in self._table.connections}
        if any(counts[key] not in {None, sum(map(len, arrays))} for key, arrays in parts.items()):
            return None
        first = 0 if start_ns is None else max(start_ns, 0)
        end = LATEST_NS if end_ns is None else end_ns - 1
        return {key: _sorted_times(arrays, first, end) for key, arrays in parts.items()}

    def _coalesced(
        self,
        requests: dict[int, ReadRequest],
        coalescer: BlockCoalescer,
        observe: BlockObserver | None,
        counts: dict[int, int] | None,
    ) -> Generator[MessageBlock, None, None]:
        """Yield blocks; count their messages in `read`, which is None if the request is limited in time."""
        with results_in_order(self._loads(requests, observe), threads=self._reader_threads()) as loaded_tasks:
            for loaded in loaded_tasks:
                self._report(loaded.split, loaded.unreadable)
                for block in loaded.blocks:
                    if counts is not None:
                        counts[block.connection] += len(block)
                    yield from coalescer.add(block, loaded.start_ns)
                yield from coalescer.flush_ready(loaded.next_ns)
            for number in requests:
                self._splits[number].check_unchanged()
            yield from coalescer.flush_all()
        if counts is not None and self._listed:
            missing = missing_after_reading(
                self.connections, self._listed, counts, self.unreadable, file=self._metadata_path
            )
            self._unreadable |= dict.fromkeys(missing)

    def _reader_threads(self) -> int:
        """Return the number of threads that read ahead; ranges of a remote file are fetched in order, so it has one."""
        if self.size_bytes <= _SMALL_RECORDING_BYTES or pa.cpu_count() == 1:
            return 0
        if self.is_remote:
            return 1
        return min(pa.cpu_count() - 1, _MAX_READERS)

    def _loads(
        self, requests: dict[int, ReadRequest], observe: BlockObserver | None
    ) -> Generator[Callable[[], _LoadedTask], None, None]:
        """Yield a function for each task, which reads and decompresses its messages."""
        numbers = list(requests)
        tasks = [
            (self._splits[number].start_ns, partial(_read_tasks, self._splits[number], request))
            for number, request in requests.items()
        ]
        for merged in merge_by_time(tasks):
            yield partial(self._load, numbers[merged.split], merged, observe)

    def _load(self, split: int, merged: MergedTask, observe: BlockObserver | None) -> _LoadedTask:
        try:
            result = merged.task.load()
        except BagError as err:
            result = ReadResult([], [UnreadableRange(0, err.what)])
        blocks: list[MessageBlock] = []
        for block in result.blocks:
            connection = self.connections[self._table.connection_id(split, block.connection)]
            if observe is not None:
                observe(split, connection.id, block)
            messages = (
                decompress_messages(block, result.unreadable)
                if connection.encoding is Encoding.CDR
                else block
            )
            if len(messages):
                blocks.append(replace(copy_if_small(messages), connection=connection.id))
        return _LoadedTask(split, blocks, result.unreadable, merged.task.start_ns, merged.next_ns)

    def _report(self, split: int, unreadable: Sequence[UnreadableRange]) -> None:
        """Add unreadable ranges of a split, with its path and the recording's connection ids."""
        file = str(self._splits[split].path)
        for gap in unreadable:
            connection = None if gap.connection is None else self._table.connection_id(split, gap.connection)
            self._unreadable[replace(gap, file=file, connection=connection)] = None


def _sorted_times(parts: Sequence[Int64s], first_ns: int, last_ns: int) -> Int64s:
    """Return the times from `first_ns` to `last_ns`, both inclusive; negative times are beyond the year 2262."""
    if not parts:
        return np.zeros(0, np.int64)
    times = np.concatenate(parts)
    if bool((times[1:] < times[:-1]).any()):
        times.sort()
    return times[np.searchsorted(times, first_ns, "left") : np.searchsorted(times, last_ns, "right")]


def no_topics_error(recording: Recording) -> NothingMatched | BagError:
    """Return the error for a recording without connections: the damage that hides them, if there is any."""
    where = str(recording.files[0])
    return damage_error(recording, "topic") or NothingMatched("the recording has no topics", where=where)


def damage_error(recording: Recording, what: str) -> BagError | None:
    """Return the error for a recording whose damage hides all topics or messages; None if it is intact."""
    if not recording.unreadable:
        return None
    damage = next((gap for gap in recording.unreadable if gap.count != 0), recording.unreadable[0])
    is_refused = CHUNK_LIMIT_KEY in damage.reason
    return BagError(
        f"no {what} can be read: {damage.reason}",
        where=f"{damage.file or recording.files[0]}: at {damage.offset}",
        hint=f"raise {CHUNK_LIMIT_KEY} if you trust the recording" if is_refused else DAMAGE_HELP,
    )


class _LoadedTask(Struct, frozen=True):
    """The result of one task, ready to be coalesced; its connection ids are those of the recording."""

    split: int
    blocks: list[MessageBlock]
    unreadable: list[UnreadableRange]
    start_ns: int
    next_ns: int


def _read_tasks(split: SplitReader, request: ReadRequest) -> Iterator[ReadTask]:
    """Yield the tasks of a split; if it fails, its remainder is unreadable and the other splits are still read."""
    try:
        yield from split.read_tasks(request)
    except BagError as err:
        gap = UnreadableRange(0, err.what)
        yield ReadTask(LATEST_NS, lambda: ReadResult([], [gap]))


class ConnectionTable:
    """The connections of a recording, and the connections of each split that they consist of."""

    def __init__(self, splits: Sequence[SplitReader], resolver: Resolver) -> None:
        self._ids: dict[tuple[int, int], int] = {}
        self._merged: list[Connection] = []
        self._of_topic: dict[str, list[int]] = defaultdict(list)
        definitions = _DefinitionCache(resolver)
        for number, split in enumerate(splits):
            for connection in split.connections:
                definition = definitions.resolve(connection)
                self._ids[number, connection.id] = self._merge(_resolved(connection, definition))
        self.connections: tuple[Connection, ...] = tuple(self._merged)

    def connection_id(self, split: int, split_connection: int) -> int:
        """Return the id of the connection that a split's connection belongs to."""
        return self._ids[split, split_connection]

    def split_connections(self, split: int, connections: Collection[int]) -> frozenset[int]:
        """Return the ids within a split of some of the recording's connections."""
        return frozenset(
            key for (number, key), merged in self._ids.items() if number == split and merged in connections
        )

    def _merge(self, connection: Connection) -> int:
        """Merge the connection into an equal one of another split, or add it; return the id."""
        for merged in (self._merged[number] for number in self._of_topic[connection.topic]):
            if _are_equal(merged, connection):
                counts = (merged.count, connection.count)
                count = None if None in counts else sum(count or 0 for count in counts)
                latched = merged.latched or connection.latched
                self._merged[merged.id] = replace(merged, count=count, latched=latched)
                return merged.id
        number = len(self._merged)
        self._of_topic[connection.topic].append(number)
        self._merged.append(replace(connection, id=number))
        return number


class _DefinitionCache:
    """Caches the resolver's answers per type and embedded text."""

    def __init__(self, resolver: Resolver) -> None:
        self._resolver = resolver
        self._cache: dict[tuple[Encoding, str, Embedded | None, int], Definition | str] = {}

    def resolve(self, connection: SplitConnection) -> Definition | str:
        """Return the connection's definition, or the reason why there is none."""
        entry = MESSAGE_ENCODINGS.get(connection.encoding)
        if entry is None:
            return refusal(connection.attributes.get("encoding", ""))
        key = (connection.encoding, connection.msgtype, connection.embedded, connection.ros_version)
        if key not in self._cache:
            try:
                self._cache[key] = self._read(connection, entry)
            except BagError as err:
                self._cache[key] = str(err)
        definition = self._cache[key]
        if isinstance(definition, str) or definition.source in {Source.BAG, Source.CUSTOM}:
            return definition
        difference = definition_difference(definition, connection.attributes)
        if difference is None:
            return definition
        remedy = "provide the definition with custom_msgs"
        return f"the known definition of {definition.root} differs from the recorded one: {difference} — {remedy}"

    def _read(self, connection: SplitConnection, entry: MessageEncoding) -> Definition:
        if entry.read_schema is not None:
            return entry.read_schema(connection.msgtype, connection.embedded)
        return self._resolver.resolve(
            connection.msgtype, connection.embedded, ros_version=connection.ros_version
        )


def _resolved(connection: SplitConnection, definition: Definition | str) -> Connection:
    is_resolved = isinstance(definition, Definition)
    return Connection(
        id=-1,
        topic=connection.topic,
        msgtype=definition.root if is_resolved else normalize_msgtype(connection.msgtype),
        encoding=connection.encoding,
        count=connection.count,
        definition=definition if is_resolved else None,
        problem=None if is_resolved else definition,
        latched=connection.latched or _is_transient_local(connection),
        attributes=connection.attributes,
    )


def _is_transient_local(connection: SplitConnection) -> bool:
    """Return whether late subscribers receive old messages too, which ROS 1 calls latched."""
    profiles = connection.attributes.get("offered_qos_profiles", "")
    return re.search(r"durability:\s*(1|transient_local)\b", profiles) is not None


def _are_equal(first: Connection, second: Connection) -> bool:
    """Return whether messages of both connections have the same topic, type, encoding and fields."""
    if (first.topic, first.msgtype, first.encoding, first.problem) != (
        second.topic,
        second.msgtype,
        second.encoding,
        second.problem,
    ):
        return False
    a, b = first.definition, second.definition
    if a is None or b is None:
        return a is b
    if a.language is not Language.ROS and a.text != b.text:
        return False
    return a is b or (a.ros_version == b.ros_version and a.types == b.types)


def recording_findings(
    splits: Sequence[SplitReader],
    connections: Sequence[Connection],
    unreadable: Sequence[UnreadableRange],
    metadata: Metadata | None,
) -> tuple[Finding, ...]:
    """Return the findings of an opened recording: notes, damage, connections, differences from its metadata.

    Raises:
        BagError: The file cannot be read.
    """
    findings = [
        Finding("container-note", Severity.INFO, f"{split.path}: {note}")
        for split in splits
        for note in split.notes
    ]
    findings += (
        Finding("unreadable-range", Severity.WARNING, f"{gap.file}: at {gap.offset}: {gap.reason}")
        for gap in unreadable
    )
    findings += (
        Finding("damaged-record", Severity.WARNING, f"{split.path}: {problem}", help=DAMAGE_HELP)
        for split in splits
        if isinstance(split, HasAttachments)
        for problem in split.damaged_records()
    )
    findings += _connection_findings(connections)
    if metadata:
        findings += (
            Finding(
                "metadata-differs",
                Severity.INFO,
                f"{metadata.path}: {difference}",
                help="the messages in the files take precedence over the metadata",
            )
            for difference in _metadata_differences(connections, metadata)
        )
    return tuple(findings)


def _connection_findings(connections: Sequence[Connection]) -> Iterator[Finding]:
    types: dict[str, set[str]] = defaultdict(set)
    for connection in connections:
        types[connection.topic].add(connection.msgtype)
        if connection.encoding is Encoding.OTHER:
            message = f"{connection.topic} is skipped: {connection.problem}"
            yield Finding("skipped-encoding", Severity.WARNING, message)
    for topic, names in types.items():
        if len(names) > 1:
            message = f"{topic} has messages of {len(names)} types: {', '.join(sorted(names))}"
            yield Finding("mixed-types", Severity.WARNING, message)


def _metadata_differences(connections: Sequence[Connection], metadata: Metadata) -> Iterator[str]:
    connections_by_topic: dict[str, list[Connection]] = defaultdict(list)
    for connection in connections:
        connections_by_topic[connection.topic].append(connection)
    for topic in metadata.topics:
        for difference in _topic_differences(topic, connections_by_topic.pop(topic.topic, [])):
            yield f"{topic.topic}: {difference}"
    for topic, unlisted in connections_by_topic.items():
        if any(connection.count != 0 for connection in unlisted):
            yield f"{topic} is not in the metadata"


def _topic_differences(topic: MetadataTopic, connections: Sequence[Connection]) -> Iterator[str]:
    if not connections:
        return
    types = {connection.msgtype for connection in connections}
    if {name.replace("/msg/", "/") for name in types} != {topic.msgtype.replace("/msg/", "/")}:
        yield f"type {topic.msgtype} in the metadata, {', '.join(sorted(types))} in the files"
    counts = [connection.count for connection in connections]
    total = sum(count or 0 for count in counts)
    if None not in counts and total > topic.count:
        yield f"{topic.count} messages in the metadata, {total} in the files"
    attributes = connections[0].attributes
    if topic.qos and attributes.get("offered_qos_profiles", topic.qos).strip() != topic.qos.strip():
        yield "the QoS profiles in the metadata differ from those in the files"
    encoding = attributes.get("encoding", "")
    if topic.serialization_format and encoding and topic.serialization_format != encoding:
        yield f"serialization {topic.serialization_format} in the metadata, {encoding} in the files"


def time_bounds(recording: Recording) -> tuple[int, int]:
    """Return the log times of the first and last message; read the recording if it has no index."""
    if recording.start_ns is not None and recording.end_ns is not None:
        return recording.start_ns, recording.end_ns
    times = [(int(block.log_times.min()), int(block.log_times.max())) for block in recording.message_blocks()]
    return min((first for first, _ in times), default=0), max((last for _, last in times), default=0)


def time_slices(
    recording: Recording, connection_ids: Collection[int], *, max_bytes: int = _MAX_SLICE_BYTES
) -> Iterator[list[MessageBlock]]:
    """Yield all blocks of one time slice after the other; halve slices of more than `max_bytes`.

    The first and the last slice have no outer bound, because an index may be wrong about the time range.
    """
    first, last = time_bounds(recording)
    step = max((last - first) // min(recording.size_bytes // _SLICE_BYTES + 1, _MAX_SLICES) + 1, 1)
    inner = range(first + step, last + 1, step)
    slices = list(zip((None, *inner), (*inner, None), strict=True))[::-1]
    while slices:
        start_ns, end_ns = slices.pop()
        start, end = first if start_ns is None else start_ns, last + 1 if end_ns is None else end_ns
        limit = max_bytes if end - start > 1 else None
        blocks = _read_slice(recording, connection_ids, start_ns, end_ns, limit)
        if blocks is None:
            middle = start + (end - start) // 2
            slices += [(middle, end_ns), (start_ns, middle)]
        else:
            yield blocks


def _read_slice(
    recording: Recording,
    connection_ids: Collection[int],
    start_ns: int | None,
    end_ns: int | None,
    max_bytes: int | None,
) -> list[MessageBlock] | None:
    """Return the blocks of a slice, or None if they have more than `max_bytes` of payload."""
    blocks, size = list[MessageBlock](), 0
    for block in recording.message_blocks(connection_ids, start_ns=start_ns, end_ns=end_ns):
        blocks.append(block)
        size += block.payload_bytes
        if max_bytes is not None and size > max_bytes:
            return None
    return blocks
