"""An asynchronous write buffer: batches wait, limited in bytes, while a thread writes them."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.destinations import TopicWriter

_INTERRUPTED_S = 20.0
"""Seconds to wait for the writing thread after an interrupt: the destination may not respond."""
_MIN_WAKE_BYTES = 1 << 20
"""Queued bytes at which the thread is woken: waking it costs more than writing one small batch."""


class WriteBuffer:
    """Writes batches in order on its own thread; `put` blocks while too many bytes are queued.

    The thread starts when enough bytes are queued; if they never are, the exit of the context writes the batches.

    The first error of a writer stops the thread, and is raised by the next `put` or by the exit of the context. The exit
    waits until everything is written, also after an exception, so that rows accepted before an error are kept. After
    Ctrl-C it waits for a limited time.
    """

    def __init__(self, *, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._queue: deque[tuple[TopicWriter, pa.RecordBatch, int]] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.busy_s = 0.0
        """Seconds that the thread spent writing."""
        self.written_rows = 0
        """Number of rows that the writers accepted."""
        self._thread = threading.Thread(target=self._run, name="mosaico-ingest-write", daemon=True)
        self._finished = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._closed = True
            needs_thread = self._thread.ident is not None or kind is KeyboardInterrupt
            if needs_thread:
                self._wake()
        if needs_thread:
            self._join(interrupted=kind is KeyboardInterrupt)
        else:
            self._work()
        if self._error is not None and (kind is None or isinstance(self._error, KeyboardInterrupt)):
            raise self._error

    def _join(self, *, interrupted: bool) -> None:
        """Wait until the thread has written everything, after an interrupt for a limited time."""
        try:
            if not interrupted:
                self._finished.wait()
        except KeyboardInterrupt:
            interrupted = True
            raise
        finally:
            # before Python 3.13, an interrupted `join` marks the thread as ended
            if self._finished.wait(_INTERRUPTED_S if interrupted else None):
                self._thread.join()
            with self._changed:
                self._queue.clear()

    def put(self, writer: TopicWriter, batch: pa.RecordBatch) -> None:
        """Queue a batch, blocking until there is space; a batch larger than the buffer is queued alone."""
        size = batch.nbytes
        with self._changed:
            while self._error is None and self._queued_bytes and self._queued_bytes + size > self._max_bytes:
                self._wake()  # the queue may still be below the wake-up size
                self._changed.wait()
            if self._error is not None:
                raise self._error
            self._queue.append((writer, batch, size))
            self._queued_bytes += size
            if self._queued_bytes >= min(_MIN_WAKE_BYTES, self._max_bytes):
                self._wake()

    def _wake(self) -> None:
        if self._thread.ident is None:
            self._thread.start()
        self._changed.notify_all()

    def _run(self) -> None:
        try:
            self._work()
        finally:
            self._finished.set()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._queue and not self._closed:
                    self._changed.wait()
                if not self._queue:
                    return
                writer, batch, size = self._queue.popleft()
            start = time.perf_counter()
            try:
                writer.write(batch)
            except BaseException as error:  # noqa: BLE001 - `put` or the exit of the context raises it again
                with self._changed:
                    self._error = error
                    self._queue.clear()
                    self._changed.notify_all()
                return
            with self._changed:
                self.busy_s += time.perf_counter() - start
                self.written_rows += batch.num_rows
                self._queued_bytes -= size
                self._changed.notify_all()
