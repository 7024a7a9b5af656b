"""Upload one topic: batches split and coalesced into messages of bounded size."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.flight as fl
from numpy.typing import NDArray

from mosaico_ingest.destinations.base import check_batch, topic_schema
from mosaico_ingest.destinations.server.client import DeadlinePassed, within
from mosaico_ingest.destinations.server.errors import Address, late, reraise
from mosaico_ingest.errors import SinkError
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.protocol.messages import Permission

__all__ = [
    "Memory",
    "Upload",
    "encoded_bits",
    "framing_bytes",
    "row_spans",
]

_BUFFERS = 3
"""Of one column at most: validity, offsets, values."""
_PER_BUFFER_BYTES = 64 + 16
"""Padding, and the buffer's entry in the message's head."""
_PER_COLUMN_BYTES = 16
_HEAD_BYTES = 1024
_OFFSETS: dict[pa.DataType, type[np.integer[Any]]] = {
    pa.string(): np.int32,
    pa.binary(): np.int32,
    pa.large_string(): np.int64,
    pa.large_binary(): np.int64,
}


def framing_bytes(schema: pa.Schema) -> int:
    """Return the most that one message of these columns is larger than its rows."""
    columns = sum(_columns(field.type) for field in schema)
    return _HEAD_BYTES + columns * (_BUFFERS * _PER_BUFFER_BYTES + _PER_COLUMN_BYTES)


def row_spans(batch: pa.RecordBatch, *, most_bytes: int) -> list[tuple[int, int, int]]:
    """Return first row, row count and size in bytes of pieces of at most `most_bytes`, as few as there can be.

    A row that is larger is a piece of its own.
    """
    if batch.nbytes <= most_bytes:
        return [(0, batch.num_rows, batch.nbytes)] if batch.num_rows else []
    ends = _batch_bits(batch)
    spans: list[tuple[int, int, int]] = []
    row = 0
    while row < batch.num_rows:
        fits = int(np.searchsorted(ends, ends[row] + most_bytes * 8, side="right")) - 1
        stop = max(fits, row + 1)
        spans.append((row, stop - row, -(-int(ends[stop] - ends[row]) // 8)))
        row = stop
    return spans


def encoded_bits(array: pa.Array[Any]) -> NDArray[np.int64]:
    """Return how many bits the rows before each one take when encoded, shape (n + 1,)."""
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
    # Any other type of varying width: its bytes, shared out evenly.
    return rows * (-(-array.nbytes * 8 // max(len(array), 1)))


def _within(values: Any, offsets: NDArray[np.integer[Any]]) -> NDArray[np.int64]:  # noqa: ANN401 - every array class
    """Return what of the values lies before each offset, counted from the first."""
    each = _fixed_bits(values.type)
    if each is not None:  # no array as long as the values, which may be millions
        return (offsets.astype(np.int64) - int(offsets[0])) * (each + _validity_bits(values))
    before = encoded_bits(values)[offsets]
    return before - before[0]


def _validity_bits(array: pa.Array[Any]) -> int:
    return 1 if array.null_count else 0


def _fixed_bits(kind: pa.DataType) -> int | None:
    """Return how many bits every value takes beside its own validity, None where they differ."""
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


_UPLOAD_S = 600.0
"""How long the server may take for one message: ten minutes are 75 kB/s for the largest."""
_LOCK_S = 2.0
"""At the end all writers are done; a lock that is still held then belongs to a call that is stuck."""


class Memory:
    """The memory that the uploads of a session share."""

    def __init__(self, *, most_bytes: int) -> None:
        self.uploads: list[Upload] = []
        self._most_bytes = most_bytes

    def relieve(self) -> None:
        """Send what the upload holds that holds most, where all of them hold too much."""
        if sum(upload.waiting_bytes for upload in self.uploads) > self._most_bytes:
            max(self.uploads, key=lambda upload: upload.waiting_bytes).flush()


class Upload:
    """The writer of one topic; several threads may write. After an error of the stream it takes no more."""

    def __init__(
        self,
        name: str,
        ontology: OntologyType,
        begin: Callable[[pa.Schema], fl.FlightStreamWriter],
        *,
        message_bytes: int,
        memory: Memory,
        address: Address,
    ) -> None:
        self.name = name
        self.waiting_bytes = 0
        self.broken: SinkError | None = None
        self._stuck = False
        self._doing = f"the upload of {name}"
        self._schema = topic_schema(ontology)
        self._rows_bytes = message_bytes - framing_bytes(self._schema)
        self._message_bytes = message_bytes
        self._memory = memory
        self._address = address
        self._waiting: list[pa.RecordBatch] = []
        self._lock = threading.Lock()
        self._stream = begin(self._schema)
        memory.uploads.append(self)

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows; see `TopicWriter.write`."""
        check_batch(batch, self._schema, where=self.name)
        spans = row_spans(batch, most_bytes=self._rows_bytes)
        self._refuse_large(batch, spans)
        with self._lock:
            for row, count, size in spans:
                if self.waiting_bytes + size > self._rows_bytes:
                    self._flush()
                self._waiting.append(batch.slice(row, count))
                self.waiting_bytes += size
        self._memory.relieve()

    def flush(self) -> None:
        """Send what is waiting."""
        with self._lock:
            self._flush()

    def close(self) -> None:
        """Send what is waiting and wait for the server's word that it has everything."""
        if not self._lock.acquire(timeout=_LOCK_S):
            raise self._late()
        try:
            self._flush()
            self._guarded(self._stream.done_writing)
            self._guarded(self._stream.close)
        finally:
            self._lock.release()

    def abandon(self) -> None:
        """End the stream, whatever becomes of it; one that is stuck ends with the process."""
        if self._stuck or not self._lock.acquire(timeout=_LOCK_S):
            return
        try:
            self._waiting.clear()
            self.waiting_bytes = 0
            within(_LOCK_S, self._stream.close)
        except (pa.ArrowException, DeadlinePassed) as error:
            self.broken = self.broken or SinkError(type(error).__name__, where=self.name)
        finally:
            self._lock.release()

    def _flush(self) -> None:
        if self.broken is not None:
            raise self.broken
        waiting, self._waiting, self.waiting_bytes = self._waiting, [], 0
        for message in pa.Table.from_batches(waiting, self._schema).combine_chunks().to_batches():
            self._guarded(lambda message=message: self._stream.write_batch(message))

    def _guarded(self, call: Callable[[], object]) -> None:
        try:
            within(_UPLOAD_S, call)
        except DeadlinePassed as error:
            self._stuck = True
            self.broken = self._late()
            raise self.broken from error
        except pa.ArrowException as error:
            try:
                reraise(error, self._address, doing=self._doing, needs=Permission.WRITE)
            except SinkError as failure:
                self.broken = failure
                raise

    def _late(self) -> SinkError:
        return late(self._address, self._doing)

    def _refuse_large(self, batch: pa.RecordBatch, spans: list[tuple[int, int, int]]) -> None:
        for row, _, size in spans:
            if size > self._rows_bytes:
                raise SinkError(
                    f"the row of {batch.column(0)[row].as_py()} ns has {size} bytes, "
                    f"the server takes {self._message_bytes} in one message",
                    where=self.name,
                    hint="raise the server's grpc_max_decode_message_size, or leave the topic out",
                )
