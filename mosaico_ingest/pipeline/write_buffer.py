"""This file is the asynchronous write buffer: batches wait here, bounded in bytes, while a thread writes them."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.destinations.base import TopicWriter

__all__ = ["WriteBuffer"]

_INTERRUPTED_S = 20.0
_WORTH_WAKING_BYTES = 1 << 20
"""Batches of small topics wait for company: handing over to a thread costs more than writing one."""


class WriteBuffer:
    """Writes batches in order on one thread of its own; `put` waits while too many bytes are queued.

    As long as little is queued there is no thread; if that is all there is, it is written on leaving.

    The first error of a writer stops the thread; it is raised by the next `put` or when the buffer is left.
    Leaving normally waits until everything is written; leaving by an exception too, so that rows accepted
    before an error are not lost. Leaving by Ctrl-C waits only for so long: the destination may be stuck.
    """

    def __init__(self, *, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._queue: deque[tuple[TopicWriter, pa.RecordBatch, int]] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()
        self._closed = False
        self._error: BaseException | None = None
        self.busy_s = 0.0
        """How long the thread has been writing, in seconds."""
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
        """Wait until the thread has written everything, or after an interrupt as long as is reasonable."""
        try:
            if not interrupted:
                self._finished.wait()
        except KeyboardInterrupt:
            interrupted = True
            raise
        finally:
            # an interrupted `join` takes the thread for ended before Python 3.13
            if self._finished.wait(_INTERRUPTED_S if interrupted else None):
                self._thread.join()
            with self._changed:
                self._queue.clear()

    def put(self, writer: TopicWriter, batch: pa.RecordBatch) -> None:
        """Queue a batch, waiting for room; a batch larger than the whole buffer is let in alone."""
        size = batch.nbytes
        with self._changed:
            while self._error is None and self._queued_bytes and self._queued_bytes + size > self._max_bytes:
                self._wake()  # what is queued may have waited for company
                self._changed.wait()
            if self._error is not None:
                raise self._error
            self._queue.append((writer, batch, size))
            self._queued_bytes += size
            if self._queued_bytes >= min(_WORTH_WAKING_BYTES, self._max_bytes):
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
            began = time.perf_counter()
            try:
                writer.write(batch)
            except BaseException as error:  # noqa: BLE001 - a thread's border: raised again by put or on leaving
                with self._changed:
                    self._error = error
                    self._queue.clear()
                    self._changed.notify_all()
                return
            with self._changed:
                self.busy_s += time.perf_counter() - began
                self._queued_bytes -= size
                self._changed.notify_all()
