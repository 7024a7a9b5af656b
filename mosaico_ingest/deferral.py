"""This file puts an interrupt off while what was done is being made to last."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any

from typing_extensions import Self

__all__ = ["DeferredInterrupt"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
