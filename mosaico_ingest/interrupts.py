"""Signals that ask a run to stop: counted by executors, deferred by workers and by a commit."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

from typing_extensions import Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def count_interrupts() -> Generator[list[int]]:
    """Yield a list that collects the numbers of SIGINT and SIGTERM instead of letting them raise.

    An exception in the middle of a message from a worker would leave the rest of the message in the pipe.
    """
    numbers = list[int]()
    if threading.current_thread() is not threading.main_thread():
        yield numbers
        return
    handlers = [signal.signal(number, lambda number, _: numbers.append(number)) for number in _SIGNALS]
    try:
        yield numbers
    finally:
        for number, handler in zip(_SIGNALS, handlers, strict=True):
            signal.signal(number, handler)


class StopHandler:
    """A signal handler that raises KeyboardInterrupt once, and only while interrupts are enabled."""

    def __init__(self) -> None:
        self.requested = False
        """True once a signal arrived."""
        self._enabled = False
        self._raised = False

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        """Note the signal, and interrupt now or as soon as interrupts are enabled."""
        self.requested = True
        if self._enabled:
            self.enable()

    def disable(self) -> None:
        """Defer interrupts."""
        self._enabled = False

    def enable(self) -> None:
        """Let interrupts through; raise immediately if one was deferred."""
        self._enabled = True
        if self.requested and not self._raised:
            self._raised = True
            raise KeyboardInterrupt


class DeferredInterrupt:
    """A context in which, after `defer`, the first signal is only noted; a second one goes through.

    Signals that are ignored or end the process keep their handlers. Outside the main thread, which receives every
    signal, the context does nothing.
    """

    def __init__(self) -> None:
        self.asked = False
        """True if a signal was deferred."""
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.allow()

    def defer(self) -> None:
        """Start to defer signals, unless one was deferred already."""
        if self._handlers or self.asked:
            return
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if callable(signal.getsignal(number)):
                    self._handlers[number] = signal.signal(number, self._note)

    def _note(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        self.allow()

    def allow(self) -> None:
        """Let signals through."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())
