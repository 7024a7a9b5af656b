"""This file takes the rows of one topic: they gather in memory, then go to a staged segment in row groups."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

import pyarrow as pa

from mosaico_ingest.errors import SinkError
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.sink import check_batch
from mosaico_ingest.store import files
from mosaico_ingest.store.columns import columns_of
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.segment import Segment, SegmentWriter, sorted_rows

__all__ = ["Staging", "StoreTopic"]

_FIRST_GROUP_BYTES, _GROUP_BYTES = 4 << 20, 32 << 20
"""The first row group, and the largest; between them each is twice the one before, so that writing begins early."""
_GROUP_ROWS = 1 << 20
_BIG_GROUP_BYTES = 8 << 20
_BIG_ROW_BYTES = 16 << 10
"""Rows larger than this on average gain nothing from larger groups: they are written while others are still read."""
_SEGMENT_BYTES = 512 << 20


class Staging:
    """The topics of a session, where their segments are staged, and the memory they share."""

    def __init__(self, where: AnyPath, staged: Callable[[str, int], AnyPath], *, buffer_bytes: int) -> None:
        self.where = where
        self._staged = staged
        self.topics: dict[str, StoreTopic] = {}
        self._buffer_bytes = buffer_bytes
        self._numbers = itertools.count()

    def next_path(self, topic: str) -> AnyPath:
        """Return a path no other segment of the session has."""
        return self._staged(topic, next(self._numbers))

    def relieve(self) -> None:
        """Write out the topic that holds most where all of them hold too much."""
        topics = tuple(self.topics.values())
        if sum(topic.buffered_bytes for topic in topics) > self._buffer_bytes:
            max(topics, key=lambda topic: topic.buffered_bytes).flush()


class StoreTopic:
    """The writer of one topic; several threads may write, and an error leaves its batch out as a whole."""

    def __init__(
        self, staging: Staging, name: str, ontology: OntologyType, metadata: str, *, folder: AnyPath
    ) -> None:
        self.name = name
        self.folder = folder
        """Where its segments lie once they are committed."""
        self.ontology = ontology
        self.metadata = metadata
        self._columns = columns_of(ontology)
        self.schema = self._columns.schema
        self.created_ns = time.time_ns()
        self.buffered_bytes = 0
        self.segments: list[Segment] = []
        self._staging = staging
        self._batches: list[pa.RecordBatch] = []
        self._settled = 0
        self._rows = 0
        self._most_bytes = _FIRST_GROUP_BYTES
        self._broken = False
        self._writer: SegmentWriter | None = None
        self._lock = threading.Lock()

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows; see `TopicWriter.write`."""
        check_batch(batch, self.schema, where=self.name)
        if not batch.num_rows:
            return
        with self._lock:
            self._refuse_if_broken()
            self._batches.append(batch)
            self._rows += batch.num_rows
            self.buffered_bytes += batch.nbytes
            full = self._is_full()
        if full:
            self.flush()
        else:
            self._staging.relieve()

    def _is_full(self) -> bool:
        big = self.buffered_bytes >= _BIG_ROW_BYTES * self._rows
        return (
            self.buffered_bytes >= (_BIG_GROUP_BYTES if big else self._most_bytes)
            or self._rows >= _GROUP_ROWS
        )

    def flush(self) -> None:
        """Write what is in memory as one row group."""
        with self._writing():
            self._flush()

    def close(self) -> None:
        """Write what is in memory and finish the last segment."""
        with self._writing():
            self._flush()
            self._finish_segment()

    def settle(self) -> None:
        """Wait until the segments finished so far are there to stay."""
        for segment in self.segments[self._settled :]:
            with explained(self._staging.where):
                files.settle(segment.path)
            self._settled += 1

    def abandon(self) -> None:
        """Drop what is in memory, and close the open file."""
        with self._lock:
            self._batches.clear()
            if self._writer is not None:
                self._writer.abandon()
                self._writer = None

    @contextmanager
    def _writing(self) -> Generator[None, None, None]:
        """Hold the lock; a failure inside leaves an unfinished file, so the topic can no longer be committed."""
        with self._lock, explained(self._staging.where):
            self._refuse_if_broken()
            self._broken = True
            yield
            self._broken = False

    def _refuse_if_broken(self) -> None:
        if self._broken:
            raise SinkError("an earlier write of the topic failed", where=self.name)

    def _flush(self) -> None:
        batches, self._batches = self._batches, []
        self._rows = self.buffered_bytes = 0
        if batches:
            self._most_bytes = min(2 * self._most_bytes, _GROUP_BYTES)
            self._write_group(sorted_rows(batches, self.schema))

    def _write_group(self, rows: pa.Table) -> None:
        if self._writer is not None and rows.column(0)[0].as_py() < self._writer.end_ns:
            self._finish_segment()  # a segment is sorted from its first row to its last
        if self._writer is None:
            self._writer = SegmentWriter(self._staging.next_path(self.name), self._columns, rows)
        self._writer.append(rows)
        if self._writer.written_bytes >= _SEGMENT_BYTES:
            self._finish_segment()
            self.settle()  # as much as this goes to the disk while others are still read

    def _finish_segment(self) -> None:
        if self._writer is not None:
            self.segments.append(self._writer.close())
            self._writer = None
