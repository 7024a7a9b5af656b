"""This file is the upload of one topic: rows gather until a message is full, since the server stores each as a chunk."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest.errors import SinkError
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.platform.deadlines import DeadlinePassed, within
from mosaico_ingest.platform.faults import Address, late, reraise
from mosaico_ingest.platform.sizes import framing_bytes, row_spans
from mosaico_ingest.sink import check_batch, topic_schema
from mosaico_ingest.wire.actions import Permission

__all__ = ["Memory", "Upload"]

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
