"""This file defers interrupts: an executor counts them, a worker raises them only between two messages, a commit is finished first."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

from typing_extensions import Self

__all__ = ["DeferredInterrupt", "Stop", "counted_interrupts"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def counted_interrupts() -> Generator[list[int]]:
    """Collect requests to stop instead of raising: an exception in the middle of a message would cost the channel."""
    asked = list[int]()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = [signal.signal(number, lambda number, _: asked.append(number)) for number in _SIGNALS]
    try:
        yield asked
    finally:
        for number, handler in zip(_SIGNALS, before, strict=True):
            signal.signal(number, handler)


class Stop:
    """A signal handler that interrupts once, and not while it is held off."""

    def __init__(self) -> None:
        self.asked = False
        self._held = True
        self._raised = False

    def __call__(self, _signal: int, _frame: FrameType | None) -> None:
        """Take note, and interrupt now or when it is no longer held off."""
        self.asked = True
        if not self._held:
            self.heed()

    def hold(self) -> None:
        """Put an interrupt off."""
        self._held = True

    def heed(self) -> None:
        """Let interrupts through again, one that was put off at once."""
        self._held = False
        if self.asked and not self._raised:
            self._raised = True
            raise KeyboardInterrupt


class DeferredInterrupt:
    """From `defer` until it is left, the first signal to stop is only noted; a second one goes through.

    Signals that are ignored, or end the process at once, stay as they are. Outside the main thread, where none arrives,
    it does nothing.
    """

    def __init__(self) -> None:
        self.asked = False
        """Whether a signal was put off."""
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()

    def defer(self) -> None:
        """Begin to put signals off."""
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if callable(signal.getsignal(number)):
                    self._before[number] = signal.signal(number, self._note)

    def _note(self, _signal: int, _frame: FrameType | None) -> None:
        self.asked = True
        self._restore()

    def _restore(self) -> None:
        while self._before:
            signal.signal(*self._before.popitem())
