"""This file says what the time of a run is spent on: one clock, read where one step ends and the next begins."""

from __future__ import annotations

import time
from collections.abc import Mapping
from datetime import datetime, timezone
from enum import Enum

__all__ = ["Step", "Stopwatch"]


class Step(str, Enum):
    """What a recording's time goes into."""

    PREPARE = "prepare"
    READ = "read"
    DECODE = "decode"
    ADAPT = "adapt"
    WAIT = "wait"
    COMMIT = "commit"
    WRITE = "write"


class Stopwatch:
    """Gives every moment since it was made to a step; the writing thread adds its own, beside the rest."""

    def __init__(self) -> None:
        self.began_at = datetime.now(timezone.utc)
        self._began = self._last = time.perf_counter()
        self._seconds = dict.fromkeys(Step, 0.0)

    @property
    def elapsed_s(self) -> float:
        """Seconds since it was made."""
        return time.perf_counter() - self._began

    @property
    def seconds(self) -> Mapping[Step, float]:
        """The seconds of each step so far."""
        return self._seconds

    def lap(self, step: Step) -> None:
        """Give the time since the last lap to a step."""
        now = time.perf_counter()
        self._seconds[step] += now - self._last
        self._last = now

    def add(self, step: Step, seconds: float) -> None:
        """Give time to the step of another thread."""
        self._seconds[step] += seconds
