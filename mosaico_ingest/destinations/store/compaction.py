"""Compaction: merges small segments of a topic into larger ones, while other processes read and write the store.

The rows of a topic keep their order, and its checksum stays the same. The merged file is written and read back before one
transaction replaces the segments in the catalog. If the process is killed before the
transaction, the merged file remains and is in no catalog. After the transaction, the replaced files remain for readers that
opened the sequence earlier. Garbage collection removes the files in both cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.destinations.store import files
from mosaico_ingest.destinations.store.files import new_session_id, translate_errors
from mosaico_ingest.destinations.store.model import (
    Replacement,
    SegmentInfo,
    SequenceInfo,
    TopicInfo,
)
from mosaico_ingest.destinations.store.segment import Columns, Segment, SegmentWriter
from mosaico_ingest.destinations.store.store import Store, Window, scan, segment_problem
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import Compression
from mosaico_ingest.remote import AnyPath

MAX_BYTES = 128 << 20
"""Maximum total size of the segments that become one. Segments of half this size are not rewritten."""
_GROUP_BYTES, _GROUP_ROWS = 32 << 20, 1 << 20
"""Size of a row group."""


class Compacted(Struct, frozen=True):
    """Segments of a topic that became one segment, or the reason why they did not."""

    topic: str
    segments: int
    """Number of segments before."""
    bytes_before: int
    bytes_after: int = 0
    problem: str | None = None
    is_damaged: bool = False
    """Whether the problem is a damaged segment."""


def compact(
    store: Store,
    info: SequenceInfo,
    *,
    compression: Compression = Compression.FAST,
    max_bytes: int = MAX_BYTES,
) -> Iterator[Compacted]:
    """Merge the small segments of each topic of a sequence, and yield the result for each group of segments.

    Segments that another process replaces or removes meanwhile, and damaged segments, stay unchanged.

    Raises:
        SinkError: The store cannot be written.
    """
    for topic in info.topics:
        for run in _runs(topic.segments, max_bytes):
            yield _merge(store, topic, run, compression)


def _runs(segments: Sequence[SegmentInfo], max_bytes: int) -> Iterator[list[SegmentInfo]]:
    """Yield consecutive segments to merge.

    A run starts and ends between two time stamps, so that rows with equal time stamps keep their order.
    """
    run: list[SegmentInfo] = []
    for group in _separate(segments):
        size = _bytes(group)
        is_large = size >= max_bytes // 2
        if run and (is_large or _bytes(run) + size > max_bytes):
            yield from [run] if len(run) > 1 else []
            run = []
        if not is_large or len(group) > 1:
            run += group
        if is_large and run:
            yield run
            run = []
    if len(run) > 1:
        yield run


def _separate(segments: Iterable[SegmentInfo]) -> Iterator[list[SegmentInfo]]:
    """Yield groups of segments in time order; different groups have no time stamp in common."""
    group: list[SegmentInfo] = []
    for segment in segments:  # sorted by start
        if group and segment.start_ns > max(each.end_ns for each in group):
            yield group
            group = []
        group.append(segment)
    if group:
        yield group


def _bytes(segments: Iterable[SegmentInfo]) -> int:
    return sum(segment.stored_bytes for segment in segments)


def _merge(store: Store, topic: TopicInfo, run: list[SegmentInfo], compression: Compression) -> Compacted:
    result = Compacted(topic.name, len(run), _bytes(run))
    problem = next((f"{s.path}: {why}" for s in run if (why := segment_problem(topic, s))), None)
    if problem is not None:
        return Compacted(topic.name, len(run), result.bytes_before, problem=problem, is_damaged=True)
    session = new_session_id()
    lease = store.layout.begin(session)
    try:
        staged = store.layout.staged(session, topic.sequence, topic.name, 0)
        with translate_errors(staged):
            segment = _write(staged, topic, run, compression)
        final = store.layout.topic(topic.sequence, topic.name) / staged.name
        parts = tuple(part for each in run for part in each.parts)
        merged = SegmentInfo(
            staged, run[0].session, segment.rows, segment.stored_bytes, segment.start_ns, segment.end_ns,
            segment.checksum, parts,
        )  # fmt: skip
        _check(topic, run, merged)
        with translate_errors(final):
            store.layout.publish({staged: final})
        change = Replacement(
            topic.sequence,
            topic.name,
            tuple(store.layout.relative(each.path) for each in run),
            store.layout.relative(final),
            run[0].session,
            segment,
            parts,
        )
        if not store.catalog.replace_segments(change):
            store.layout.remove([final])
            return Compacted(
                topic.name, len(run), result.bytes_before, problem="another process changed the topic"
            )
    finally:
        lease.release()
        store.layout.discard(session)
    return Compacted(topic.name, len(run), result.bytes_before, segment.stored_bytes)


def _write(path: AnyPath, topic: TopicInfo, run: list[SegmentInfo], compression: Compression) -> Segment:
    """Write the rows of the segments in the order in which readers see them."""
    columns = Columns(topic.schema)
    writer: SegmentWriter | None = None
    try:
        for rows in _row_groups(scan(run, topic.schema, Window()), topic.schema):
            writer = writer or SegmentWriter(path, columns, rows, compression)
            writer.append(rows)
    except BaseException:
        if writer is not None:
            writer.abandon()
        raise
    assert writer is not None  # noqa: S101 - segments have rows
    segment = writer.close()
    files.sync(path)
    return segment


def _row_groups(batches: Iterable[pa.RecordBatch], schema: pa.Schema) -> Iterator[pa.Table]:
    waiting: list[pa.RecordBatch] = []
    size = rows = 0
    for batch in batches:
        waiting.append(batch)
        size, rows = size + batch.nbytes, rows + batch.num_rows
        if size >= _GROUP_BYTES or rows >= _GROUP_ROWS:
            yield pa.Table.from_batches(waiting, schema).combine_chunks()
            waiting, size, rows = [], 0, 0
    if waiting:
        yield pa.Table.from_batches(waiting, schema).combine_chunks()


def _check(topic: TopicInfo, run: list[SegmentInfo], merged: SegmentInfo) -> None:
    """Read the merged file back before it replaces others.

    Raises:
        SinkError: The file differs from the segments.
    """
    problem = segment_problem(topic, merged)
    if merged.rows != sum(segment.rows for segment in run):
        problem = f"it has {merged.rows} rows, the segments have {sum(segment.rows for segment in run)}"
    if problem is not None:
        raise SinkError(
            f"the merged file differs from the written rows: {problem}",
            where=str(merged.path),
            hint="check the disk; the segments are unchanged",
        )
