"""Writing sessions at a Mosaico server, and the uploads of their topics."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest import protocol
from mosaico_ingest.destinations import (
    StoredTopic,
    TopicWriter,
    check_batch,
    replacement_is_incomplete,
    sequence_exists,
    topic_schema,
    with_offsets,
)
from mosaico_ingest.destinations.server.client import (
    Address,
    DeadlinePassed,
    Refused,
    ServerClient,
    Uploaded,
    add_hint,
    connect,
    in_thread,
    late,
    reraise,
    within,
)
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.job.values import IfExists, ServerTarget
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Action, Permission, topic_locator

_LARGEST_ROW_SHARE = 0.8
"""Share of the server's limit that one row may take: a stored chunk grows when the server sends it back."""
_UPLOAD_S = 600.0
"""Time limit for one message: ten minutes are 17 kB/s for a message of 10 MB."""
_LOCK_S = 2.0
"""Time limit for the lock at the end of a session, when only a stuck call can still hold it."""


class MessageSizes(Struct, frozen=True):
    """The sizes of upload messages, in bytes."""

    target: int
    """Rows are coalesced up to this size; a larger row is a message of its own."""
    limit: int
    """The largest message that the server accepts and sends back."""

    @property
    def largest_row(self) -> int:
        """The largest message that clients can still read back."""
        return int(self.limit * _LARGEST_ROW_SHARE)

    def spans(self, batch: pa.RecordBatch, *, where: str) -> list[tuple[int, int, int]]:
        """Return the pieces of a batch; see `row_spans`.

        Raises:
            SinkError: A row is larger than a message that can be read back.
        """
        framing = framing_bytes(batch.schema)
        spans = row_spans(batch, max_bytes=max(1, min(self.target, self.largest_row) - framing))
        for row, count, size in spans:
            if count == 1 and size + framing > self.largest_row:
                raise SinkError(
                    f"the row of {batch.column(0)[row].as_py()} ns has {size} bytes; the server accepts messages of"
                    f" {self.limit} bytes, and can send back rows of {self.largest_row - framing} bytes",
                    where=where,
                    hint="raise the server's message limits, or exclude the topic",
                )
        return spans


class SharedBuffer:
    """The uploads of a session, and the limit of the rows that they buffer together."""

    def __init__(self, *, max_bytes: int) -> None:
        self.uploads: list[Upload] = []
        self._max_bytes = max_bytes

    def enforce_limit(self) -> None:
        """Flush the upload with the most buffered rows if all of them together exceed the limit."""
        if sum(upload.buffered_bytes for upload in self.uploads) > self._max_bytes:
            max(self.uploads, key=lambda upload: upload.buffered_bytes).flush()


class Upload:
    """The writer of one topic; several threads may write. After a stream error it accepts no more rows."""

    def __init__(
        self,
        name: str,
        ontology: OntologyType,
        start: Callable[[pa.Schema], fl.FlightStreamWriter],
        *,
        sizes: MessageSizes,
        buffer: SharedBuffer,
        address: Address,
    ) -> None:
        self.name = name
        self.buffered_bytes = 0
        self.error: SinkError | None = None
        """The error that broke the stream."""
        self._stuck = False
        self._action = f"the upload of {name}"
        self._schema = topic_schema(ontology)
        self._sizes = sizes
        self._rows_bytes = max(1, min(sizes.target, sizes.largest_row) - framing_bytes(self._schema))
        self._shared = buffer
        self._address = address
        self._batches: list[pa.RecordBatch] = []
        self._lock = threading.Lock()
        self._stream = start(self._schema)
        buffer.uploads.append(self)

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows; see `TopicWriter.write`."""
        check_batch(batch, self._schema, where=self.name)
        batch = with_offsets(batch)
        spans = self._sizes.spans(batch, where=self.name)
        with self._lock:
            for row, count, size in spans:
                if self.buffered_bytes + size > self._rows_bytes:
                    self._flush()
                self._batches.append(batch.slice(row, count))
                self.buffered_bytes += size
        self._shared.enforce_limit()

    def flush(self) -> None:
        """Send the buffered rows."""
        with self._lock:
            self._flush()

    def close(self) -> None:
        """Send the buffered rows and wait until the server confirms the topic."""
        if not self._lock.acquire(timeout=_LOCK_S):
            raise self._late()
        try:
            self._flush()
            self._call(self._stream.done_writing)
            self._call(self._stream.close)
        finally:
            self._lock.release()

    def abandon(self) -> None:
        """Close the stream and ignore errors; a stuck stream ends with the process."""
        if self._stuck or not self._lock.acquire(timeout=_LOCK_S):
            return
        try:
            self._batches.clear()
            self.buffered_bytes = 0
            within(_LOCK_S, self._stream.close)
        except (pa.ArrowException, OSError, DeadlinePassed) as error:
            self.error = self.error or SinkError(type(error).__name__, where=self.name)
        finally:
            self._lock.release()

    def _flush(self) -> None:
        if self.error is not None:
            raise self.error
        batches, self._batches, self.buffered_bytes = self._batches, [], 0
        for message in pa.Table.from_batches(batches, self._schema).combine_chunks().to_batches():
            self._call(lambda message=message: self._stream.write_batch(message))

    def _call(self, call: Callable[[], object]) -> None:
        try:
            within(_UPLOAD_S, call)
        except DeadlinePassed as error:
            self._stuck = True
            self.error = self._late()
            raise self.error from error
        except (pa.ArrowException, OSError) as error:
            try:
                reraise(error, self._address, action=self._action, needs=Permission.WRITE)
            except SinkError as failure:
                self.error = failure
                raise

    def _late(self) -> SinkError:
        return late(self._address, self._action)


_BUFFERS = 3
"""Maximum number of buffers of one column: validity, offsets, values."""
_PER_BUFFER_BYTES = 64 + 16
"""Padding, and the buffer's entry in the message header."""
_PER_COLUMN_BYTES = 16
_HEADER_BYTES = 1024
_OFFSETS: dict[pa.DataType, type[np.integer[Any]]] = {
    pa.string(): np.int32,
    pa.binary(): np.int32,
    pa.large_string(): np.int64,
    pa.large_binary(): np.int64,
}


def framing_bytes(schema: pa.Schema) -> int:
    """Return an upper bound of the bytes that a message of these columns adds to its rows."""
    columns = sum(_columns(field.type) for field in schema)
    return _HEADER_BYTES + columns * (_BUFFERS * _PER_BUFFER_BYTES + _PER_COLUMN_BYTES)


def row_spans(batch: pa.RecordBatch, *, max_bytes: int) -> list[tuple[int, int, int]]:
    """Return first row, row count and size in bytes of the fewest pieces of at most `max_bytes`.

    A row that is larger is a piece of its own.
    """
    if batch.nbytes <= max_bytes:
        return [(0, batch.num_rows, batch.nbytes)] if batch.num_rows else []
    ends = _batch_bits(batch)
    spans: list[tuple[int, int, int]] = []
    row = 0
    while row < batch.num_rows:
        last = int(np.searchsorted(ends, ends[row] + max_bytes * 8, side="right")) - 1
        stop = max(last, row + 1)
        spans.append((row, stop - row, -(-int(ends[stop] - ends[row]) // 8)))
        row = stop
    return spans


def encoded_bits(array: pa.Array[Any]) -> NDArray[np.int64]:
    """Return the cumulative encoded size in bits before each row, shape (n + 1,)."""
    rows = np.arange(len(array) + 1, dtype=np.int64)
    return rows * _validity_bits(array) + _value_bits(array, rows)


def _batch_bits(batch: pa.RecordBatch) -> NDArray[np.int64]:
    total = np.zeros(batch.num_rows + 1, dtype=np.int64)
    for column in batch.columns:
        total += encoded_bits(column)
    return total


def _value_bits(array: Any, rows: NDArray[np.int64]) -> NDArray[np.int64]:  # noqa: ANN401 - every array class
    kind = array.type
    fixed = _fixed_bits(kind)
    if fixed is not None:
        return rows * fixed
    if pa.types.is_struct(kind):
        return sum((encoded_bits(array.field(i)) for i in range(kind.num_fields)), np.zeros_like(rows))
    if pa.types.is_fixed_size_list(kind):
        return _within(array.values, (rows + array.offset) * kind.list_size)
    if isinstance(array, pa.ListArray | pa.LargeListArray):
        offsets = array.offsets.to_numpy()
        return _within(array.values, offsets) + rows * offsets.itemsize * 8
    if kind in _OFFSETS:
        offsets = _offsets(array, _OFFSETS[kind])
        return (offsets - offsets[0]) * 8 + rows * np.dtype(_OFFSETS[kind]).itemsize * 8
    # Any other type of variable width: its bytes, distributed evenly.
    return rows * (-(-array.nbytes * 8 // max(len(array), 1)))


def _within(values: Any, offsets: NDArray[np.integer[Any]]) -> NDArray[np.int64]:  # noqa: ANN401 - every array class
    """Return the size in bits of the values before each offset, relative to the first offset."""
    each = _fixed_bits(values.type)
    if each is not None:  # avoids an array as long as the values, which may be millions
        return (offsets.astype(np.int64) - int(offsets[0])) * (each + _validity_bits(values))
    before = encoded_bits(values)[offsets]
    return before - before[0]


def _validity_bits(array: pa.Array[Any]) -> int:
    return 1 if array.null_count else 0


def _fixed_bits(kind: pa.DataType) -> int | None:
    """Return the bits of every value without its own validity, None if they differ."""
    if isinstance(kind, pa.StructType | pa.FixedSizeListType):
        inner = [_fixed_bits(kind.field(i).type) for i in range(kind.num_fields)]
        each = [1 + bits for bits in inner if bits is not None]
        times = kind.list_size if isinstance(kind, pa.FixedSizeListType) else 1
        return sum(each) * times if len(each) == len(inner) else None
    try:
        return kind.bit_width
    except ValueError:
        return None


def _offsets(array: Any, kind: type[np.integer[Any]]) -> NDArray[np.int64]:  # noqa: ANN401 - string and binary arrays
    buffer = array.buffers()[1]
    if buffer is None or not len(array):
        return np.zeros(len(array) + 1, dtype=np.int64)
    offsets = np.frombuffer(buffer, dtype=kind)[array.offset : array.offset + len(array) + 1]
    return offsets.astype(np.int64)


def _columns(kind: pa.DataType) -> int:
    return 1 + sum(_columns(kind.field(i).type) for i in range(kind.num_fields))


_OLD_IS_DELETED = (
    "the old sequence is deleted and the new one is not stored; run the same command again to upload it"
)
_UNCHECKED = (
    "the session is finalized, so the sequence is stored, but its rows were not counted;"
    " `ingest status` shows whether it is complete"
)


class ServerSession:
    """One writing session; `commit` or `discard` ends it.

    A server cannot swap sequences. A session that replaces one therefore keeps its rows in temporary files, and deletes
    the stored sequence only at the commit, when the new one is complete.
    """

    def __init__(
        self,
        target: ServerTarget,
        client: ServerClient,
        sequence: str,
        metadata: str,
        *,
        if_exists: IfExists,
        buffer_bytes: int,
        amendable: bool = False,
    ) -> None:
        self._target = target
        self._client = client
        self._sequence = sequence
        self._metadata = metadata
        self._sizes = MessageSizes(target.message_bytes, client.limit_bytes)
        self._buffer = SharedBuffer(max_bytes=buffer_bytes)
        self._uploads: dict[str, Upload] = {}
        self._names: dict[str, str] = {}
        """The path of each topic by the name that was passed to `topic`."""
        self._notes: list[tuple[str | None, str]] = []
        self._session: messages.SessionCreated | None = None
        self._created = False
        self._stored_is_deleted = False
        stored = client.find(sequence)
        if stored is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)
        self._replaced = stored if if_exists is IfExists.REPLACE else None
        self._spool = _Spool(self._sizes) if self._replaced or amendable else None
        self._existing_topics = _topics_of(stored) if stored and not self._replaced else frozenset[str]()
        self._is_new = stored is None
        if stored is None and not amendable:
            self._create()

    def amend(self, metadata: Mapping[str, Any], *, sequence: str | None = None) -> None:
        """Replace the metadata, and optionally the sequence; see `AmendableSession.amend`."""
        self._metadata = protocol.check_metadata(metadata, where=sequence or self._sequence)
        if sequence is not None:
            self._sequence = protocol.check_sequence_name(sequence)
            self._replaced = self._client.find(self._sequence)
            self._is_new, self._existing_topics = self._replaced is None, frozenset()

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> TopicWriter:
        """Open a topic; see `Session.topic`."""
        path = protocol.check_topic_name(name)
        described: dict[str, Any] = json.loads(protocol.check_metadata(metadata, where=name))
        if path in self._names.values():
            raise SinkError("the topic is already open", where=name)
        if topic_locator(self._sequence, path) in self._existing_topics:
            raise SinkError(
                "the topic already exists in the sequence, and the server cannot append rows to an existing topic",
                where=name,
                hint="rename the topic in topic_settings, or replace the sequence",
            )
        if self._spool is not None:
            writer: TopicWriter = self._spool.topic(name, path, ontology, described)
        else:
            writer = self._start_upload(name, path, ontology, described)
        self._names[name] = path
        return writer

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error; see `Session.note_error`. It is sent with the commit."""
        self._notes.append((None if topic is None else protocol.check_topic_name(topic), message))

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return the server's counts, read over a new connection; see `Session.stored`."""
        try:
            with connect(self._target, handshake=False) as client:
                counts = client.uploaded(self._sequence) if self._uploads else {}
                return tuple(self._stored(client, counts, name, path) for name, path in self._names.items())
        except SinkError as error:
            add_hint(error, _UNCHECKED)
            raise

    def commit(self) -> None:
        """Upload the remaining rows, wait until the server confirms every topic, and make them visible atomically."""
        if self._spool is not None:
            self._send_spool(self._spool)
        self._delete_broken_topics()
        for closing in [in_thread(upload.close) for upload in self._uploads.values()]:
            closing.result()
        for path, message in self._notes:
            self._send_note(path, message)
        session = self._session
        if session is None:
            return
        if self._uploads:
            question = messages.SessionFinalize(session_uuid=session.uuid)
            self._act_once(messages.SESSION_FINALIZE, question, lambda: self._is_final(session))
        else:
            self._delete_session(session.locator)

    def discard(self) -> str | None:
        """Delete everything the session wrote; return a remark if something remains or was lost, else None."""
        for ending in [in_thread(upload.abandon) for upload in self._uploads.values()]:
            ending.result()
        if self._spool is not None:
            self._spool.close()
        remarks = [self._delete_remains(), _OLD_IS_DELETED if self._stored_is_deleted else None]
        return "; ".join(remark for remark in remarks if remark) or None

    def _start_upload(self, name: str, path: str, ontology: OntologyType, metadata: dict[str, Any]) -> Upload:
        locator = topic_locator(self._sequence, path)
        question = messages.TopicCreate(
            session_uuid=self._open_session().uuid,
            locator=locator,
            serialization_format=ontology.serialization_format,
            ontology_tag=ontology.tag,
            user_metadata=metadata,
        )
        created = self._client.act(messages.TOPIC_CREATE, question)
        request = messages.Put(resource_locator=locator, topic_uuid=created.uuid)
        upload = Upload(
            name,
            ontology,
            lambda schema: self._client.put(request, schema),
            sizes=self._sizes,
            buffer=self._buffer,
            address=self._client.address,
        )
        self._uploads[path] = upload
        return upload

    def _send_spool(self, spool: _Spool) -> None:
        """Upload the rows in the temporary files, after the stored sequence that they replace is deleted."""
        if self._replaced is not None and any(path is None for path, _ in self._notes):
            raise replacement_is_incomplete(self._sequence)
        spool.finish()
        if self._replaced is not None:
            self._delete_stored()
        if self._is_new or self._replaced is not None:
            self._create()
        for topic in spool.topics:
            upload = self._start_upload(topic.name, topic.path, topic.ontology, topic.metadata)
            for batch in topic.batches():
                upload.write(batch)
        spool.close()

    def _delete_stored(self) -> None:
        question = messages.Located(locator=self._sequence)
        try:
            self._client.act(messages.SEQUENCE_DELETE, question)
        except Refused as refusal:
            if refusal.condition is not Condition.PRECONDITION or self._replaced is None:
                raise
            # an upload that was killed leaves a session that was never finalized
            for session in self._replaced.sessions:
                if not session.locked:
                    self._delete_session(session.locator)
            self._client.act(messages.SEQUENCE_DELETE, question)
        self._stored_is_deleted = True

    def _delete_remains(self) -> str | None:
        try:
            if self._session is not None:
                self._delete_session(self._session.locator)
            if self._created:
                self._client.act(messages.SEQUENCE_DELETE, messages.Located(locator=self._sequence))
        except Refused as refusal:
            if refusal.condition is not Condition.NOT_FOUND:
                return f"an unfinished session of {self._sequence} remains on the server ({refusal.what})"
        except SinkError as error:
            return f"an unfinished session of {self._sequence} may remain on the server ({error.what})"
        return None

    def _create(self) -> None:
        question = messages.SequenceCreate(locator=self._sequence, user_metadata=json.loads(self._metadata))
        try:
            self._act_once(
                messages.SEQUENCE_CREATE, question, lambda: self._client.find(self._sequence) is not None
            )
        except Refused as error:
            if error.condition is Condition.EXISTS:
                raise sequence_exists(self._sequence) from error
            raise
        self._created = True

    def _open_session(self) -> messages.SessionCreated:
        """Create the session with its first topic, since a server refuses to finalize an empty one."""
        if self._session is None:
            self._session = self._client.act(
                messages.SESSION_CREATE, messages.Located(locator=self._sequence)
            )
        return self._session

    def _delete_broken_topics(self) -> None:
        """Delete the topics whose streams broke, whose errors were raised already, and keep the others."""
        for path, upload in tuple(self._uploads.items()):
            if upload.error is not None:
                del self._uploads[path]
                self._buffer.uploads.remove(upload)
                locator = topic_locator(self._sequence, path)
                self._client.act(messages.TOPIC_DELETE, messages.Located(locator=locator))

    def _send_note(self, path: str | None, message: str) -> None:
        if path in self._uploads:
            locator = topic_locator(self._sequence, path)
            note = messages.NotificationCreate(locator=locator, msg=message)
            self._client.act(messages.TOPIC_NOTIFICATION_CREATE, note)
        else:
            text = f"{path}: {message}" if path else message
            note = messages.NotificationCreate(locator=self._sequence, msg=text)
            self._client.act(messages.SEQUENCE_NOTIFICATION_CREATE, note)

    def _act_once(
        self, action: Action[Any, Any], question: messages.Body, is_done: Callable[[], bool]
    ) -> None:
        """Act; if the response was lost, check whether the action took effect before repeating it."""
        try:
            self._client.act(action, question)
        except SinkUnavailable:
            if not is_done():
                self._client.act(action, question)

    def _is_final(self, session: messages.SessionCreated) -> bool:
        info = self._client.find(self._sequence)
        return info is not None and any(s.locked for s in info.sessions if s.locator == session.locator)

    def _delete_session(self, locator: str) -> None:
        self._client.act(messages.SESSION_DELETE, messages.Located(locator=locator))

    def _stored(
        self, client: ServerClient, counts: Mapping[str, Uploaded], name: str, path: str
    ) -> StoredTopic:
        if path not in self._uploads:
            return StoredTopic(name, 0, None, None, 0)
        locator = topic_locator(self._sequence, path)
        count = counts[locator] if locator in counts else client.count_rows(locator)
        return StoredTopic(name, count.rows, count.start_ns, count.end_ns, count.stored_bytes)


class _Spool:
    """The topics of a replacement in temporary files, until the stored sequence may be deleted."""

    def __init__(self, sizes: MessageSizes) -> None:
        self.topics: list[_SpooledTopic] = []
        self._sizes = sizes
        self._files = ExitStack()
        self._folder = Path(self._files.enter_context(TemporaryDirectory(prefix="mosaico-ingest-")))

    def topic(self, name: str, path: str, ontology: OntologyType, metadata: dict[str, Any]) -> _SpooledTopic:
        file = self._folder / f"{len(self.topics)}.arrow"
        topic = _SpooledTopic(name, path, ontology, metadata, file=file, sizes=self._sizes)
        self.topics.append(topic)
        return topic

    def finish(self) -> None:
        for topic in self.topics:
            topic.finish()

    def close(self) -> None:
        with suppress(SinkError):  # the files are deleted anyway
            self.finish()
        self._files.close()


class _SpooledTopic:
    """The writer of one topic in a temporary Arrow file."""

    def __init__(
        self,
        name: str,
        path: str,
        ontology: OntologyType,
        metadata: dict[str, Any],
        *,
        file: Path,
        sizes: MessageSizes,
    ) -> None:
        self.name = name
        self.path = path
        self.ontology = ontology
        self.metadata = metadata
        self._file = file
        self._sizes = sizes
        self._schema = topic_schema(ontology)
        self._lock = Lock()
        self._finished = False
        self._writer = pa.ipc.new_stream(
            str(file), self._schema, options=pa.ipc.IpcWriteOptions(compression="lz4")
        )

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows; see `TopicWriter.write`."""
        check_batch(batch, self._schema, where=self.name)
        complete = with_offsets(batch)
        self._sizes.spans(complete, where=self.name)
        with self._lock, _spool_errors(self._file.parent):
            self._writer.write_batch(complete)

    def finish(self) -> None:
        """Complete the file; a second call has no effect."""
        with self._lock, _spool_errors(self._file.parent):
            if not self._finished:
                self._finished = True
                self._writer.close()

    def batches(self) -> pa.RecordBatchReader:
        return pa.ipc.open_stream(pa.OSFile(str(self._file), "rb"))


@contextmanager
def _spool_errors(folder: Path) -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise SinkError(
            f"a temporary file cannot be written: {error}",
            where=str(folder),
            hint="set TMPDIR to a folder with enough free space",
        ) from error


def _topics_of(sequence: messages.SequenceInfo) -> frozenset[str]:
    return frozenset(locator for session in sequence.sessions for locator in session.topics)
