"""The embedded store: open, query, read in time order, verify, delete, collect garbage."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta, timezone
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from msgspec import Struct
from xxhash import xxh3_128

from mosaico_ingest import protocol
from mosaico_ingest.destinations.store.catalog import Catalog
from mosaico_ingest.destinations.store.files import (
    ATTACHMENTS,
    LocalFiles,
    NotInStore,
    opened,
    translate_errors,
)
from mosaico_ingest.destinations.store.model import (
    AttachmentInfo,
    Collected,
    Files,
    Listing,
    NewNote,
    SegmentInfo,
    SequenceFilter,
    SequenceInfo,
    StoreCatalog,
    TopicInfo,
)
from mosaico_ingest.destinations.store.segment import ContentHash, column_makers, sorted_rows, time_span
from mosaico_ingest.display import bytes_text, count_text, time_text
from mosaico_ingest.documents import MAX_ROWS, html_table
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import one_line, suggest_names
from mosaico_ingest.job.values import parse_time
from mosaico_ingest.remote import AnyPath, RemotePath, as_path


class Checked(Struct, frozen=True):
    """A segment that was read completely, and its problem, if any."""

    topic: str
    segment: SegmentInfo
    problem: str | None


class CheckedAttachment(Struct, frozen=True):
    """An attachment that was read completely, and its problem, if any."""

    attachment: AttachmentInfo
    problem: str | None


_READ_BYTES = 1 << 20


def verify(info: SequenceInfo) -> Iterator[Checked]:
    """Read every segment of a sequence and compare pages, rows and checksums with the catalog."""
    for topic in info.topics:
        for segment in topic.segments:
            yield Checked(topic.name, segment, segment_problem(topic, segment))


def verify_attachments(info: SequenceInfo) -> Iterator[CheckedAttachment]:
    """Read every attachment of a sequence and compare its size and checksum with the catalog."""
    for attachment in info.attachments:
        yield CheckedAttachment(attachment, _attachment_problem(attachment))


def _attachment_problem(attachment: AttachmentInfo) -> str | None:
    digest, size = xxh3_128(), 0
    try:
        with attachment.path.open("rb") as file:
            while chunk := file.read(_READ_BYTES):
                digest.update(chunk)
                size += len(chunk)
    except FileNotFoundError:
        return "the file does not exist"
    except OSError as error:
        return str(error).partition("\n")[0]
    if (size, digest.hexdigest()) == (attachment.stored_bytes, attachment.checksum):
        return None
    form = "{} bytes and the checksum {}"
    expected = form.format(attachment.stored_bytes, attachment.checksum)
    return f"the catalog has {expected}, the file has {form.format(size, digest.hexdigest())}"


def segment_problem(topic: TopicInfo, segment: SegmentInfo) -> str | None:
    """Read a segment completely and return how it differs from the catalog, or None."""
    try:
        with opened(segment.path, page_checksum_verification=True) as file:
            if not file.schema_arrow.equals(topic.schema):
                return "its columns differ from the columns of its topic"
            content = ContentHash(column_makers(file.schema_arrow))
            actual = (segment.path.stat().st_size, *_rows_and_span(file, content))
    except FileNotFoundError:
        return "the file does not exist"
    except (OSError, pa.ArrowException) as error:
        return str(error).partition("\n")[0]
    expected = (segment.stored_bytes, segment.rows, segment.start_ns, segment.end_ns)
    if actual != expected:
        form = "{} bytes, {} rows in [{}, {}]"
        return f"the catalog has {form.format(*expected)}, the file has {form.format(*actual)}"
    if segment.checksum not in {None, content.hexdigest()}:
        return f"its rows have the checksum {content.hexdigest()}, the catalog has {segment.checksum}"
    return None


def _rows_and_span(file: pq.ParquetFile, content: ContentHash) -> tuple[int, int, int]:
    """Add the rows of the file to `content`; return their count, and the time span of the row groups' statistics."""
    rows = 0
    for batch in file.iter_batches(batch_size=1 << 12):
        content.add(batch)
        rows += batch.num_rows
    spans = [time_span(file.metadata, group) for group in range(file.num_row_groups)]
    return rows, min((low for low, _ in spans), default=0), max((high for _, high in spans), default=0)


_BATCH_ROWS = 1 << 16


class Window(Struct, frozen=True):
    """A time range with inclusive start and exclusive end; None is unbounded."""

    start_ns: int | None = None
    end_ns: int | None = None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Return whether rows from `start_ns` to `end_ns`, both inclusive, may be inside."""
        early = self.start_ns is not None and end_ns < self.start_ns
        late = self.end_ns is not None and start_ns >= self.end_ns
        return not early and not late

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether all rows from `start_ns` to `end_ns`, both inclusive, are inside."""
        early = self.start_ns is not None and start_ns < self.start_ns
        late = self.end_ns is not None and end_ns >= self.end_ns
        return not early and not late

    def cut(self, batch: pa.RecordBatch) -> pa.RecordBatch:
        """Return the rows inside without copying them; the batch is sorted."""
        times = batch.column(0).to_numpy()
        start = 0 if self.start_ns is None else int(np.searchsorted(times, self.start_ns))
        end = len(times) if self.end_ns is None else int(np.searchsorted(times, self.end_ns))
        return batch.slice(start, max(0, end - start))


def scan(segments: Sequence[SegmentInfo], schema: pa.Schema, window: Window) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the columns in `schema`, sorted by `timestamp_ns`, its first column."""
    in_window = [segment for segment in segments if window.overlaps(segment.start_ns, segment.end_ns)]
    for together in _overlapping(in_window):
        streams = [_read(segment, schema, window) for segment in together]
        yield from streams[0] if len(streams) == 1 else _merge(streams, schema)


def count(
    segments: Sequence[SegmentInfo], schema: pa.Schema, window: Window
) -> tuple[int, int | None, int | None]:
    """Return the number of rows inside the window, and their first and last time stamp."""
    times = pa.schema([schema.field(0)])
    rows, stamps = 0, list[int]()
    for segment in segments:
        if window.covers(segment.start_ns, segment.end_ns):
            rows += segment.rows
            stamps += [segment.start_ns, segment.end_ns]
            continue
        for batch in scan([segment], times, window):
            rows += batch.num_rows
            stamps += [batch.column(0)[0].as_py(), batch.column(0)[-1].as_py()]
    return rows, min(stamps, default=None), max(stamps, default=None)


def _overlapping(segments: Iterable[SegmentInfo]) -> Iterator[list[SegmentInfo]]:
    """Yield groups of segments in time order; the time ranges of different groups do not overlap."""
    group: list[SegmentInfo] = []
    end_ns = 0
    for segment in sorted(segments, key=lambda each: each.start_ns):
        if group and segment.start_ns >= end_ns:
            yield group
            group = []
        end_ns = max(end_ns, segment.end_ns) if group else segment.end_ns
        group.append(segment)
    if group:
        yield group


def _read(segment: SegmentInfo, schema: pa.Schema, window: Window) -> Iterator[pa.RecordBatch]:
    with translate_errors(str(segment.path)), opened(segment.path) as file:
        for group in range(file.num_row_groups):
            if not window.overlaps(*time_span(file.metadata, group)):
                continue
            for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=schema.names):
                inside = window.cut(batch)
                if inside.num_rows:
                    yield pa.RecordBatch.from_arrays(inside.columns, schema=schema)


def _merge(streams: Sequence[Iterator[pa.RecordBatch]], schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    """Yield the rows of sorted streams in order, with one batch of each stream in memory."""
    heads = [next(stream, None) for stream in streams]
    while live := [head for head in heads if head is not None]:
        horizon = min(head.column(0)[-1].as_py() for head in live)
        ready: list[pa.RecordBatch] = []
        for i, head in enumerate(heads):
            if head is None:
                continue
            split = int(np.searchsorted(head.column(0).to_numpy(), horizon, side="right"))
            ready.append(head.slice(0, split))
            heads[i] = head.slice(split) if split < head.num_rows else next(streams[i], None)
        yield from sorted_rows(ready, schema).combine_chunks().to_batches(_BATCH_ROWS)


_GRACE_S = 10.0


class Store(Struct, frozen=True):
    """Parquet segments and their catalog; opened by `Store.open`."""

    layout: Files
    catalog: StoreCatalog

    @classmethod
    def open(cls, path: str | AnyPath, *, create: bool = True) -> Store:
        """Open the store in a folder or behind a URL, and create it if necessary and `create` is set.

        Raises:
            SinkError: The store does not exist, cannot be opened, or was created by a newer version.
        """
        root = as_path(path)
        if isinstance(root, RemotePath):
            from mosaico_ingest.destinations.store.files import ObjectFiles  # noqa: PLC0415 - only stores behind URLs need it
            from mosaico_ingest.destinations.store.object_catalog import ObjectCatalog  # noqa: PLC0415 - only stores behind URLs need it

            bucket = ObjectFiles(root)
            return cls(bucket, ObjectCatalog(bucket, create=create))
        layout = LocalFiles(root)
        return cls(layout, Catalog(layout.catalog, create=create))

    @classmethod
    def find(cls, path: AnyPath) -> Store | None:
        """Open the store in a folder or behind a URL, or return None if it does not exist."""
        if isinstance(path, RemotePath):
            from mosaico_ingest.destinations.store.files import ObjectFiles  # noqa: PLC0415 - only stores behind URLs need it

            is_there = ObjectFiles(path).is_there()
        else:
            is_there = LocalFiles(path).catalog.is_file()
        return cls.open(path, create=False) if is_there else None

    def __repr__(self) -> str:
        """Return the location, such as `<Store mosaico>`."""
        return one_line(f"<Store {self.path}>")

    def _repr_html_(self) -> str:
        """Return a table of the first sequences for a notebook."""
        listing = self.listing(limit=MAX_ROWS)
        rows = (
            (
                each.name,
                count_text(each.topics),
                count_text(each.rows),
                bytes_text(each.stored_bytes),
                time_text(each.start_ns),
            )
            for each in listing.sequences
        )
        names = ("sequence", "topics", "rows", "size", "start")
        return html_table(
            repr(self)[1:-1], names, rows, count=len(self.names()), numbers={"topics", "rows", "size"}
        )

    @property
    def path(self) -> AnyPath:
        """The folder or URL of the store."""
        return self.layout.root

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence, sorted by name."""
        return self.catalog.sequences()

    def listing(
        self,
        *,
        match: str | None = None,
        metadata: Mapping[str, str] | None = None,
        incomplete: bool = False,
        after: str | None = None,
        limit: int | None = None,
    ) -> Listing:
        """Return a page of summaries, sorted by name; its cost does not depend on the number of sequences.

        Args:
            match: A glob for the names.
            metadata: Required values by dotted key, as text.
            incomplete: Select only incomplete sequences.
            after: Return sequences after this name; see `Listing.next_after`.
            limit: Maximum number of sequences, or None for all.
        """
        selection = SequenceFilter(match, metadata or {}, incomplete)
        return self.catalog.listing(selection, after=after, limit=limit)

    def names(self) -> tuple[str, ...]:
        """Return the names of all sequences, sorted."""
        return tuple(self.catalog.names())

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """Return the smallest and largest value of columns (`pose.x`) by segment path, if they are known."""
        return self.catalog.bounds(topic, columns)

    def find_sequence(self, name: str) -> SequenceInfo | None:
        """Return a sequence, or None."""
        return self.catalog.sequence(name)

    def sequence(self, name: str) -> SequenceInfo:
        """Return one sequence.

        Raises:
            SinkError: It does not exist; the hint names existing ones.
        """
        info = self.catalog.sequence(name)
        if info is None:
            names = self.catalog.names()
            raise NotInStore(
                f"there is no sequence {name!r}", where=str(self.path), hint=suggest_names(names, [name])
            )
        return info

    def topic(self, sequence: str, topic: str) -> TopicInfo:
        """Return one topic; its leading slash is optional.

        Raises:
            SinkError: It does not exist; the hint names existing ones.
        """
        return self.sequence(sequence).topic(topic)

    def create_sequence(self, sequence: str, metadata: Mapping[str, Any]) -> None:
        """Create a sequence without sessions; a `StoreSink` creates sequences itself.

        Raises:
            SequenceExists: The sequence exists.
            SinkError: The name or the metadata is refused.
        """
        described = protocol.check_metadata(metadata, where=sequence)
        self.catalog.create(protocol.check_sequence_name(sequence), described)

    def add_note(self, sequence: str, message: str, *, topic: str | None = None) -> None:
        """Attach an error to a sequence, or to one of its topics."""
        self.catalog.note(sequence, NewNote(topic, message, time.time_ns()))

    def delete_notes(self, sequence: str, *, topic: str | None = None) -> None:
        """Remove the notes of a sequence itself, or of one topic."""
        self.catalog.delete_notes(sequence, topic)

    def paths(self, sequence: str, topic: str) -> tuple[AnyPath, ...]:
        """Return the Parquet files of a topic, each sorted by `timestamp_ns`."""
        return tuple(segment.path for segment in self.topic(sequence, topic).segments)

    def scan(
        self,
        sequence: str,
        topic: str,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        columns: Sequence[str] | None = None,
    ) -> pa.RecordBatchReader:
        """Read a topic's rows sorted by `timestamp_ns`, from `start_ns` (inclusive) to `end_ns` (exclusive).

        `columns` selects top-level columns; `timestamp_ns` is always the first column.
        """
        info = self.topic(sequence, topic)
        schema = info.schema
        if columns is not None:
            schema = _chosen(schema, columns, where=f"{sequence}{info.name}")
        return pa.RecordBatchReader.from_batches(
            schema, scan(info.segments, schema, Window(start_ns, end_ns))
        )

    def delete_sequence(self, sequence: str) -> None:
        """Remove a sequence; raises SinkError if it does not exist."""
        info = self.catalog.sequence(sequence)
        paths = self.catalog.delete_sequence(sequence)
        self.layout.remove([*(self.path / path for path in paths), *_attachment_paths(info)])

    def delete_topic(self, sequence: str, topic: str) -> None:
        """Remove a topic; raises SinkError if it does not exist."""
        self._remove(self.catalog.delete_topic(sequence, f"/{topic.removeprefix('/')}"))

    def delete_session(self, sequence: str, session: str) -> None:
        """Remove the content of a session; raises SinkError if it does not exist."""
        info = self.catalog.sequence(sequence)
        paths = self.catalog.delete_session(sequence, session)
        self.layout.remove([*(self.path / path for path in paths), *_attachment_paths(info, session)])

    def collect_garbage(self, *, grace_s: float = _GRACE_S) -> Collected:
        """Remove files that crashed writers and interrupted deletions left behind.

        Live sessions are kept, and so are staging folders younger than `grace_s`, which may be locked soon.
        """
        with translate_errors(self.path):
            files = list(self.layout.segment_files())
            sessions = self.layout.open_sessions()
            live = {session for session in sessions if self.layout.in_use(session, grace_s)}
            paths = self.catalog.forget(live)
            if any(self.layout.relative(file).startswith(f"{ATTACHMENTS}/") for file in files):
                attachments = (path for info in self.catalog.sequences() for path in _attachment_paths(info))
                paths |= {self.layout.relative(path) for path in attachments}
            orphans = [file for file in files if self._is_orphan(file, paths, live)]
            dead = sorted(set(sessions) - live)
            staged = [file for session in dead for file in self.layout.staged_files(session)]
            stored_bytes = sum(file.stat().st_size for file in (*orphans, *staged))
            self.layout.remove(orphans)
            for session in dead:
                self.layout.discard(session)
        return Collected(len(dead), len(orphans) + len(staged), stored_bytes)

    def _remove(self, paths: Iterable[str]) -> None:
        self.layout.remove(self.path / path for path in paths)

    def _is_orphan(self, file: AnyPath, known: set[str], live: set[str]) -> bool:
        return self.layout.relative(file) not in known and file.name.partition("-")[0] not in live


def _attachment_paths(info: SequenceInfo | None, session: str | None = None) -> list[AnyPath]:
    """Return the paths of a sequence's attachments, or of the attachments that one session stored."""
    attachments = () if info is None else info.attachments
    return [each.path for each in attachments if session in {None, each.session}]


def _chosen(schema: pa.Schema, columns: Sequence[str], *, where: str) -> pa.Schema:
    unknown = [name for name in columns if name not in schema.names]
    if unknown:
        raise SinkError(
            f"there is no column {unknown[0]!r}", where=where, hint=suggest_names(schema.names, unknown[:1])
        )
    names = dict.fromkeys([schema.names[0], *columns])
    return pa.schema([schema.field(name) for name in names])


Moment: TypeAlias = "int | str | datetime"
"""A time: ns since the epoch, a text such as `2026-03-01T12:00:00Z`, `+10s` or `-5s`, or a `datetime` (UTC by default)."""

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def bound_ns(topic: TopicInfo, moment: Moment | None) -> int | None:
    """Return a time in ns since the epoch; `+10s` counts from the first row of the topic, `-5s` from the last.

    Raises:
        SinkError: The text is not a time.
    """
    if moment is None or isinstance(moment, int):
        return moment
    if isinstance(moment, datetime):
        aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        return (aware - _EPOCH) // timedelta(microseconds=1) * 1000
    try:
        bound = parse_time(moment)
    except ValueError as error:
        raise SinkError(str(error), where=f"{topic.sequence}{topic.name}") from error
    if not bound.relative:
        return bound.ns
    origin = topic.end_ns if moment.startswith("-") else topic.start_ns
    return (origin or 0) + bound.ns


def topic_reader(
    topic: TopicInfo,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
    columns: Sequence[str] | None = None,
) -> pa.RecordBatchReader:
    """Return a reader of the rows ordered by time; `columns` are names of top-level columns."""
    schema = topic.schema
    if columns is not None:
        _check(topic, columns, schema.names)
        schema = pa.schema([schema.field(name) for name in dict.fromkeys([schema.names[0], *columns])])
    window = Window(bound_ns(topic, start), bound_ns(topic, end))
    return pa.RecordBatchReader.from_batches(schema, scan(topic.segments, schema, window))


def read_table(
    topic: TopicInfo,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
    columns: Sequence[str] | None = None,
    flatten: bool = False,
) -> pa.Table:
    """Return the rows from `start` (inclusive) to `end` (exclusive), ordered by time.

    `columns` selects columns (`pose`) and members of structs (`pose.position.x`); `timestamp_ns` is always the first
    column. `flatten` replaces each struct with one column per member, such as `pose.position.x`.

    Raises:
        SinkError: A column does not exist; the hint names existing ones.
    """
    if columns is None:
        table = topic_reader(topic, start=start, end=end).read_all()
    else:
        _check(topic, columns, _paths(topic.schema, ""))
        names = list(dict.fromkeys(path.partition(".")[0] for path in columns))
        table = _selected(topic_reader(topic, start=start, end=end, columns=names).read_all(), columns)
    while flatten and any(pa.types.is_struct(field.type) for field in table.schema):
        table = table.flatten()
    return table


def _check(topic: TopicInfo, columns: Sequence[str], known: Sequence[str]) -> None:
    for name in columns:
        if name not in known:
            raise SinkError(
                f"there is no column {name!r}",
                where=f"{topic.sequence}{topic.name}",
                hint=suggest_names(known, [name]),
            )


def _selected(table: pa.Table, columns: Sequence[str]) -> pa.Table:
    paths = list(dict.fromkeys([table.schema.names[0], *columns]))
    member: Any = pc.struct_field  # its stubs accept no list of names
    values = [
        member(table.column(path.partition(".")[0]), path.split(".")[1:])
        if "." in path
        else table.column(path)
        for path in paths
    ]
    return pa.table(values, names=paths)


def _paths(fields: Any, prefix: str) -> list[str]:  # noqa: ANN401 - a schema or a struct type
    paths: list[str] = []
    for field in fields:
        paths.append(f"{prefix}{field.name}")
        if pa.types.is_struct(field.type):
            paths += _paths(field.type, f"{prefix}{field.name}.")
    return paths
