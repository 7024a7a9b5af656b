"""Upload one topic: batches split and coalesced into messages of bounded size."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.destinations.base import check_batch, topic_schema
from mosaico_ingest.destinations.server.client import DeadlinePassed, within
from mosaico_ingest.destinations.server.errors import Address, late, reraise
from mosaico_ingest.errors import SinkError
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.protocol.batches import with_offsets
from mosaico_ingest.protocol.messages import Permission

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
