"""This file runs an iterator one step ahead in a thread, and leaves no thread behind."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterator
from contextlib import closing, suppress
from types import TracebackType
from typing import Generic, TypeVar

from mosaico_ingest.frozen import frozen

__all__ = ["Prefetched"]

T = TypeVar("T")
_LOOK_SECONDS = 0.1


@frozen
class _End:
    error: BaseException | None


class Prefetched(Generic[T]):
    """An iterator over `source`, of which `ahead` items are made before they are asked for.

    The source runs in one thread, which has ended when the context is left; its errors are raised here.
    """

    def __init__(self, source: Generator[T, None, None], *, ahead: int = 1) -> None:
        self._source = source
        self._items: queue.Queue[tuple[T] | _End] = queue.Queue(maxsize=ahead)
        self._stop = threading.Event()
        self._worker = threading.Thread(target=self._work, name="mosaico-prefetch", daemon=True)

    def __enter__(self) -> Iterator[T]:
        """Start the thread and return the items."""
        self._worker.start()
        return self._consume()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the thread and wait for it."""
        self._stop.set()
        with suppress(queue.Empty):
            self._items.get_nowait()  # the thread may be waiting for room
        self._worker.join()

    def _consume(self) -> Iterator[T]:
        while not isinstance(item := self._items.get(), _End):
            yield item[0]
        if item.error is not None:
            raise item.error

    def _work(self) -> None:
        error: BaseException | None = None
        try:
            with closing(self._source):
                for value in self._source:
                    if not self._put((value,)):
                        return
        except BaseException as err:  # noqa: BLE001 - the border of the thread; raised again where it is consumed
            error = err
        self._put(_End(error))

    def _put(self, item: tuple[T] | _End) -> bool:
        while not self._stop.is_set():
            try:
                self._items.put(item, timeout=_LOOK_SECONDS)
            except queue.Full:
                continue
            return True
        return False
