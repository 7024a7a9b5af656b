"""This file defers interrupts: an executor counts them, and a worker raises them only between two messages."""

from __future__ import annotations

import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Stop", "counted_interrupts"]


@contextmanager
def counted_interrupts() -> Generator[list[int]]:
    """Collect requests to stop instead of raising: an exception in the middle of a message would cost the channel."""
    asked = list[int]()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _: asked.append(number)) for number in numbers]
    try:
        yield asked
    finally:
        for number, handler in zip(numbers, before, strict=True):
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
