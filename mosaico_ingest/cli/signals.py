"""This file makes a polite request to stop look like Ctrl-C."""

from __future__ import annotations

import signal
from types import FrameType

__all__ = ["end_on_signals", "interrupt_on_terminate"]


def interrupt_on_terminate() -> None:
    """Treat SIGTERM as Ctrl-C, so that the session policy applies to both."""
    signal.signal(signal.SIGTERM, _interrupt)


def end_on_signals() -> None:
    """Let a signal end the process without a word: all is done, and what it would raise now only a traceback could say."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
