"""This file makes a polite request to stop look like Ctrl-C."""

from __future__ import annotations

import signal
from types import FrameType

__all__ = ["interrupt_on_terminate"]


def interrupt_on_terminate() -> None:
    """Treat SIGTERM as Ctrl-C, so that the session policy applies to both."""
    signal.signal(signal.SIGTERM, _interrupt)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
