"""Writing sessions of a store: buffered rows, threads that write row groups, and the group commit."""

from __future__ import annotations

import itertools
import json
import os
import re
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from typing import Any

import pyarrow as pa
from msgspec import Struct
from xxhash import xxh3_128

from mosaico_ingest import protocol
from mosaico_ingest.destinations import (
    Attached,
    Session,
    StoredTopic,
    check_batch,
    check_same_type,
    replacement_is_incomplete,
    with_offsets,
)
from mosaico_ingest.destinations.store import files
from mosaico_ingest.destinations.store.files import new_session_id, translate_errors
from mosaico_ingest.destinations.store.model import Claim, Files, NewNote, NewSession, NewTopic, StoreCatalog
from mosaico_ingest.destinations.store.segment import (
    Segment,
    SegmentWriter,
    columns_of,
    combined,
    sorted_rows,
    time_span,
)
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import IngestError, SinkError
from mosaico_ingest.job.values import ATTACHMENTS_KEY, Compression, IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import AnyPath, RemotePath

Group = Future[None]
"""A row group that is written or waits; its result is an error or None."""


class GroupWriters:
    """Writes row groups on threads. `submit` blocks while each thread has a group, which limits the memory."""

    def __init__(self, threads: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="group")
        self._slots = threading.BoundedSemaphore(threads)
        self._error: BaseException | None = None

    def submit(self, previous: Group | None, write: Callable[[], None]) -> Group:
        """Write a group after the previous group of its topic; an error of that group is the error of this group too."""
        self._slots.acquire()
        return self._pool.submit(self._write, previous, write)

    def check(self) -> None:
        """Raise the first error of any group."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Drop the groups that wait, and wait for the others."""
        self._pool.shutdown(cancel_futures=True)

    def _write(self, previous: Group | None, write: Callable[[], None]) -> None:
        try:
            if previous is not None:
                previous.result()  # it started earlier, so it does not wait for this thread
            write()
        except BaseException as error:
            self._error = self._error or error
            raise
        finally:
            self._slots.release()


class Closed(Struct, frozen=True):
    """What a closed session commits."""

    claim: Claim
    new: NewSession
    unsynced: tuple[AnyPath, ...]
    """The staged files that may not be on the disk yet."""
    moves: Mapping[AnyPath, AnyPath]
    """The final path of each staged file."""
    obsolete: tuple[AnyPath, ...]
    """The files of the stored sequence that are in no catalog table and that the commit replaces."""


def commit_sessions(sessions: Sequence[StoreSession]) -> list[Exception | None]:
    """Commit closed sessions of one store in one transaction; return the error of each session, or None.

    If they cannot be committed together, each is committed alone, so that an error affects only its own session. If their
    files cannot be synced, all of them fail, because the system reports an error of the disk only once. A session with an
    error is discarded.
    """
    layout = sessions[0].layout
    try:
        with translate_errors(layout.root):
            layout.sync([path for session in sessions for path in session.closed.unsynced])
    except BaseException as error:
        for session in sessions:
            session.discard()
        if isinstance(error, Exception):
            return [error] * len(sessions)
        raise
    return _publish(sessions)


def _publish(sessions: Sequence[StoreSession]) -> list[Exception | None]:
    """Move the files of the sessions to their final paths, and enter the sessions in the catalog."""
    layout, catalog = sessions[0].layout, sessions[0].catalog
    contents = [session.closed for session in sessions]
    try:
        with translate_errors(layout.root):
            layout.publish({staged: final for each in contents for staged, final in each.moves.items()})
        replaced = catalog.commit([(each.claim, each.new) for each in contents])
    except BaseException as error:
        if isinstance(error, Exception) and len(sessions) > 1:
            return [result for session in sessions for result in _publish([session])]
        for session in sessions:
            session.withdraw()
        if isinstance(error, Exception):
            return [error]
        raise
    for session in sessions:
        session.leave()
    obsolete = [path for each in contents for path in each.obsolete]
    layout.remove([*(layout.root / path for path in replaced), *obsolete])
    return [None] * len(sessions)


_FIRST_GROUP_BYTES, _GROUP_BYTES = 4 << 20, 32 << 20
"""Size of the first and the largest row group. Sizes double in between, so that writing starts early."""
_GROUP_ROWS = 1 << 20
_BIG_GROUP_BYTES = 8 << 20
_BIG_ROW_BYTES = 16 << 10
"""Rows that are larger on average gain nothing from larger row groups."""
_SEGMENT_BYTES = 512 << 20
_MAX_WRITERS = 4
"""Maximum number of threads that write row groups; one core is left to the threads that read and convert."""
_REFUSED = re.compile(r"[^A-Za-z0-9._-]")
_MAX_NAME = 100
"""Maximum length of the part of a file's name that comes from the recording."""


class Staging:
    """The topics of a session, the paths of their staged segments, and their shared buffer."""

    def __init__(
        self,
        where: AnyPath,
        staged: Callable[[str, int], AnyPath],
        *,
        buffer_bytes: int,
        compression: Compression = Compression.FAST,
        writers: GroupWriters | None = None,
    ) -> None:
        self.where = where
        self.compression = compression
        self.writers = writers
        """None if the caller's thread writes the row groups."""
        self._staged = staged
        self.topics: dict[str, StoreTopic] = {}
        self._buffer_bytes = buffer_bytes
        self._numbers = itertools.count()

    def next_path(self, topic: str) -> AnyPath:
        """Return a path that no other segment of the session has."""
        return self._staged(topic, next(self._numbers))

    def enforce_limit(self) -> None:
        """Flush the topic with the most buffered rows if all of them together exceed the limit."""
        topics = tuple(self.topics.values())
        if sum(topic.buffered_bytes for topic in topics) > self._buffer_bytes:
            max(topics, key=lambda topic: topic.buffered_bytes).flush()


class StoreTopic:
    """The writer of one topic; several threads may write, and an error rejects the complete batch."""

    def __init__(
        self, staging: Staging, name: str, ontology: OntologyType, metadata: str, *, folder: AnyPath
    ) -> None:
        self.name = name
        self.folder = folder
        """The folder of its committed segments."""
        self.ontology = ontology
        self.metadata = metadata
        self._columns = columns_of(ontology)
        self.schema = self._columns.schema
        self.created_ns = time.time_ns()
        self.buffered_bytes = 0
        self.segments: list[Segment] = []
        self._staging = staging
        self._batches: list[pa.RecordBatch] = []
        self._synced = 0
        self._rows = 0
        self._group_bytes = _FIRST_GROUP_BYTES
        self._broken = False
        self._group: Group | None = None
        """The row group that was last handed to the writers of the session."""
        self._writer: SegmentWriter | None = None
        self._lock = threading.Lock()

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows; see `TopicWriter.write`."""
        check_batch(batch, self.schema, where=self.name)
        if not batch.num_rows:
            return
        if self._columns.has_nested_lists:
            batch = with_offsets(batch)
        if self._staging.writers is not None:
            self._staging.writers.check()
        with self._lock:
            self._check_usable()
            self._batches.append(batch)
            self._rows += batch.num_rows
            self.buffered_bytes += batch.nbytes
            full = self._is_full()
        if full:
            self.flush()
        else:
            self._staging.enforce_limit()

    def _is_full(self) -> bool:
        big = self.buffered_bytes >= _BIG_ROW_BYTES * self._rows
        return (
            self.buffered_bytes >= (_BIG_GROUP_BYTES if big else self._group_bytes)
            or self._rows >= _GROUP_ROWS
        )

    def flush(self) -> None:
        """Write the buffered rows as one row group, or hand them to the writers of the session."""
        writers = self._staging.writers
        if writers is None:
            with self._writing():
                self._flush()
            return
        with self._lock:
            self._check_usable()
            batches = self._take_batches()
        if batches:
            self._group = writers.submit(self._group, partial(self._write_later, batches))

    def close(self) -> None:
        """Write the buffered rows and finish the last segment."""
        if self._group is not None:
            self._group.result()
        with self._writing():
            self._flush()
            self._finish_segment()

    @property
    def unsynced(self) -> tuple[AnyPath, ...]:
        """The finished segments that may not be on the disk yet."""
        return tuple(segment.path for segment in self.segments[self._synced :])

    def sync(self) -> None:
        """Wait until the finished segments are on the disk."""
        for path in self.unsynced:
            with translate_errors(self._staging.where):
                files.sync(path)
            self._synced += 1

    def abandon(self) -> None:
        """Drop the buffered rows and close the open file."""
        with self._lock:
            self._batches.clear()
            if self._writer is not None:
                self._writer.abandon()
                self._writer = None

    @contextmanager
    def _writing(self) -> Generator[None, None, None]:
        """Hold the lock; after an error inside, the topic cannot be committed."""
        with self._lock:
            self._check_usable()
            with self._breaking():
                yield

    @contextmanager
    def _breaking(self) -> Generator[None, None, None]:
        """After an error inside, the file is incomplete."""
        try:
            with translate_errors(self._staging.where):
                yield
        except BaseException:
            self._broken = True
            raise

    def _check_usable(self) -> None:
        if self._broken:
            raise SinkError("an earlier write of the topic failed", where=self.name)

    def _flush(self) -> None:
        batches = self._take_batches()
        if batches:
            self._write_group(sorted_rows(batches, self.schema))

    def _write_later(self, batches: Sequence[pa.RecordBatch]) -> None:
        """Write a row group on a thread of the session; the lock stays free for the next batches."""
        with self._breaking():
            self._write_group(sorted_rows(batches, self.schema))

    def _take_batches(self) -> list[pa.RecordBatch]:
        batches, self._batches = self._batches, []
        self._rows = self.buffered_bytes = 0
        if batches:
            self._group_bytes = min(2 * self._group_bytes, _GROUP_BYTES)
        return batches

    def _write_group(self, rows: pa.Table) -> None:
        if self._writer is not None and rows.column(0)[0].as_py() < self._writer.end_ns:
            self._finish_segment()  # a segment is sorted from its first row to its last
        if self._writer is None:
            self._writer = SegmentWriter(
                self._staging.next_path(self.name), self._columns, rows, self._staging.compression
            )
        self._writer.append(rows)
        if self._writer.written_bytes >= _SEGMENT_BYTES:
            self._finish_segment()
            self.sync()  # large segments reach the disk before the commit

    def _finish_segment(self) -> None:
        if self._writer is not None:
            self.segments.append(self._writer.close())
            self._writer = None


_WORTH_A_THREAD_BYTES = 1 << 18
"""Minimum size of a topic that is closed on a thread of its own; behind a URL, every topic is."""
_WAITING = 2
"""Number of additional threads, since threads that wait for the disk do not use a core."""


class _Attachment(Struct, frozen=True):
    """A staged file of the sequence."""

    name: str
    """The name of the file in the store."""
    staged: AnyPath
    file: Attached
    size_bytes: int
    checksum: str


def _file_name(name: str) -> str:
    """Return the part of an attachment's name that the name of its file contains."""
    return _REFUSED.sub("_", name.rpartition("/")[2])[-_MAX_NAME:]


class StoreSession:
    """One writing session: `close` finishes its files, then `commit_sessions` or `discard` ends it."""

    def __init__(
        self,
        layout: Files,
        catalog: StoreCatalog,
        sequence: str,
        metadata: str,
        *,
        if_exists: IfExists,
        buffer_bytes: int,
        compression: Compression = Compression.FAST,
        keep_catalog_open: bool = True,
        writer_threads: int = 1,
    ) -> None:
        self.id = new_session_id()
        self.created_ns = time.time_ns()
        self.layout = layout
        self.catalog = catalog
        self._metadata = metadata
        self._topics: dict[str, StoreTopic] = {}
        self._notes: list[NewNote] = []
        self._attachments: list[_Attachment] = []
        self._closed: Closed | None = None
        self._staging = Staging(
            layout.root,
            partial(layout.staged, self.id, sequence),
            buffer_bytes=buffer_bytes,
            compression=compression,
            writers=GroupWriters(writer_threads) if writer_threads > 1 else None,
        )
        self._lease = layout.begin(self.id)
        self._open_catalog = ExitStack()
        try:
            if keep_catalog_open:
                self._open_catalog.enter_context(closing(catalog.keep_open()))
            self._claim = catalog.claim(self.id, sequence, if_exists, is_live=layout.is_live)
        except BaseException:
            self.leave()
            raise

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> StoreTopic:
        """Open a topic; see `Session.topic`."""
        path = protocol.check_topic_name(name)
        described = protocol.check_metadata(metadata, where=name)
        if path in self._staging.topics:
            raise SinkError("the topic is already open", where=name)
        existing = self._claim.types.get(path)
        if existing is not None:
            check_same_type(existing, ontology, where=name)
        with translate_errors(name):
            folder = self.layout.topic(self._claim.sequence, path)
            topic = StoreTopic(self._staging, path, ontology, described, folder=folder)
        self._staging.topics[path] = self._topics[name] = topic
        return topic

    def attach(self, file: Attached, chunks: Iterable[bytes]) -> None:
        """Store a file of the sequence; see `AttachableSession.attach`."""
        name = f"{self.id}-{len(self._attachments):04}-{_file_name(file.name)}"
        staged = self.layout.staged_attachment(self.id, self._claim.sequence, name)
        digest, size = xxh3_128(), 0
        try:
            with translate_errors(file.name), files.create(staged) as target:
                for chunk in chunks:
                    target.write(chunk)
                    digest.update(chunk)
                    size += len(chunk)
            with translate_errors(file.name):
                files.sync(staged)
        except BaseException:
            with suppress(IngestError, OSError):
                staged.unlink()
            raise
        self._attachments.append(_Attachment(name, staged, file, size, digest.hexdigest()))

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error; see `Session.note_error`."""
        path = None if topic is None else protocol.check_topic_name(topic)
        self._notes.append(NewNote(path, message, time.time_ns()))

    def amend(self, metadata: Mapping[str, Any], *, sequence: str | None = None) -> None:
        """Replace the metadata, and optionally the sequence; see `AmendableSession.amend`."""
        where = sequence or self._claim.sequence
        self._metadata = protocol.check_metadata(metadata, where=where)
        if sequence is None:
            return
        name = protocol.check_sequence_name(sequence)
        self.catalog.release(self.id, self._claim.sequence)
        self._claim = self.catalog.claim(self.id, name, IfExists.REPLACE, is_live=self.layout.is_live)
        with translate_errors(name):
            for topic in self._staging.topics.values():
                topic.folder = self.layout.topic(name, topic.name)

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return the content according to the footers of the committed files; see `Session.stored`."""
        return tuple(self._stored(name, topic) for name, topic in self._topics.items())

    def close(self) -> None:
        """Finish the files of every topic; `commit_sessions` makes them durable and visible."""
        ended_early = any(note.topic is None for note in self._notes)
        if ended_early and self._claim.if_exists is IfExists.REPLACE and self._claim.sequence_id is not None:
            raise replacement_is_incomplete(self._claim.sequence)
        self._close_topics()
        topics = tuple(self._staging.topics.values())
        moves = {
            segment.path: topic.folder / segment.path.name for topic in topics for segment in topic.segments
        }
        moves |= {each.staged: self._final(each) for each in self._attachments}
        metadata = self._metadata_with_attachments()
        self._closed = Closed(
            self._claim,
            NewSession(
                self.id, metadata, self.created_ns, tuple(map(self._placed, topics)), tuple(self._notes)
            ),
            unsynced=tuple(path for topic in topics for path in topic.unsynced),
            moves=moves,
            obsolete=self._replaced_attachments(),
        )

    @property
    def closed(self) -> Closed:
        """The content of the session, after `close`."""
        assert self._closed is not None  # noqa: S101 - callers close the session first
        return self._closed

    def commit(self) -> None:
        """Close the session and commit it in a group of its own."""
        self.close()
        (error,) = commit_sessions([self])
        if error is not None:
            raise error

    def _final(self, attachment: _Attachment) -> AnyPath:
        return self.layout.attachment(self._claim.sequence, attachment.name)

    def _metadata_with_attachments(self) -> str:
        """Return the metadata of the session with the list of its attachments."""
        if not self._attachments:
            return self._metadata
        entries = [
            {
                "path": self.layout.relative(self._final(each)),
                "name": each.file.name,
                "media_type": each.file.media_type,
                "log_ns": each.file.log_ns,
                "create_ns": each.file.create_ns,
                "bytes": each.size_bytes,
                "checksum": each.checksum,
            }
            for each in self._attachments
        ]
        metadata = {**json.loads(self._metadata), ATTACHMENTS_KEY: entries}
        return protocol.check_metadata(metadata, where=self._claim.sequence)

    def _replaced_attachments(self) -> tuple[AnyPath, ...]:
        """Return the attachments of the stored sequence that the commit replaces."""
        if self._claim.if_exists is not IfExists.REPLACE or self._claim.sequence_id is None:
            return ()
        info = self.catalog.sequence(self._claim.sequence)
        return () if info is None else tuple(each.path for each in info.attachments)

    def _close_topics(self) -> None:
        """Close large topics on threads, and small topics on this thread meanwhile."""
        # the largest topic comes first, so that it does not finish long after the others
        waiting = sorted(self._staging.topics.values(), key=lambda topic: -topic.buffered_bytes)
        most = 0 if isinstance(self.layout.root, RemotePath) else _WORTH_A_THREAD_BYTES
        large = [topic for topic in waiting if topic.buffered_bytes >= most]
        small = waiting[len(large) :]
        with ThreadPoolExecutor((os.cpu_count() or 1) + _WAITING, thread_name_prefix="segment") as pool:
            closing_large = pool.map(_close_and_sync, large)
            for topic in small:
                topic.close()
            list(closing_large)

    def discard(self) -> None:
        """Delete everything the session wrote."""
        if self._staging.writers is not None:
            self._staging.writers.close()
        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="segment") as pool:
            list(pool.map(StoreTopic.abandon, self._staging.topics.values()))
        try:
            self.catalog.release(self.id, self._claim.sequence)
        except SinkError:
            return  # the original error is more important, and the claim ends with the lease
        finally:
            self.leave()

    def withdraw(self) -> None:
        """Discard the session after its files were moved to their final paths."""
        if not self._may_be_committed():
            self.layout.remove(self.closed.moves.values())
        self.discard()

    def _may_be_committed(self) -> bool:
        """Return whether the catalog may contain the session although its commit failed, since the response may be lost.

        If the catalog cannot be read, the files are kept: garbage collection removes files that are not needed.
        """
        try:
            info = self.catalog.sequence(self._claim.sequence)
        except IngestError:
            return True
        return info is not None and any(session.id == self.id for session in info.sessions)

    def _placed(self, topic: StoreTopic) -> NewTopic:
        relative = self.layout.relative(topic.folder)
        segments = {f"{relative}/{segment.path.name}": segment for segment in topic.segments}
        return NewTopic(topic.name, topic.ontology, topic.schema, topic.metadata, topic.created_ns, segments)

    def _stored(self, name: str, topic: StoreTopic) -> StoredTopic:
        rows = stored_bytes = 0
        times: list[int] = []
        for segment in topic.segments:
            path = topic.folder / segment.path.name
            with translate_errors(path):
                footer = files.footer(path)
                stored_bytes += path.stat().st_size
                rows += footer.num_rows
                for group in range(footer.num_row_groups):
                    times += time_span(footer, group)
        checksum = combined(s.checksum for s in sorted(topic.segments, key=lambda s: (s.start_ns, s.path)))
        return StoredTopic(
            name, rows, min(times, default=None), max(times, default=None), stored_bytes, checksum
        )

    def leave(self) -> None:
        """Release everything that the session holds; a second call has no effect."""
        if self._staging.writers is not None:
            self._staging.writers.close()
        self._open_catalog.close()
        self._lease.release()
        self.layout.discard(self.id)


def _close_and_sync(topic: StoreTopic) -> None:
    topic.close()
    topic.sync()


_BUFFER_BYTES = 96 << 20


class StoreSink(Struct, frozen=True):
    """Writes sequences into a store; one session buffers at most about `buffer_bytes`.

    The normal exit of a session commits it or, if `deferred` is set, only closes it for `commit_sessions`.
    """

    store: Store
    buffer_bytes: int = _BUFFER_BYTES
    compression: Compression = Compression.FAST
    deferred: bool = False

    @contextmanager
    def open(
        self,
        sequence: str,
        metadata: Mapping[str, Any],
        *,
        if_exists: IfExists = IfExists.FAIL,
        amendable: bool = False,  # noqa: ARG002 - every session is
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        session = StoreSession(
            self.store.layout,
            self.store.catalog,
            protocol.check_sequence_name(sequence),
            protocol.check_metadata(metadata, where=sequence),
            if_exists=if_exists,
            buffer_bytes=self.buffer_bytes,
            compression=self.compression,
            # The groups of all threads together need no more memory than the buffer.
            writer_threads=min(pa.cpu_count() - 1, _MAX_WRITERS, self.buffer_bytes // _GROUP_BYTES),
        )
        try:
            yield session
            if self.deferred:
                session.close()
            else:
                session.commit()
        except BaseException:
            session.discard()
            raise
