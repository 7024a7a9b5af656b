"""The timeline of messages per topic, and the clock of a run's steps."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.documents import Part

__all__ = [
    "MOST_STRETCHES",
    "Step",
    "Stopwatch",
    "Timeline",
    "TimelineReport",
]

MOST_STRETCHES = 120
_FIRST_STEP_NS = 1_000_000


class TimelineReport(Part):
    """How many rows there are in equal stretches of time; a stretch without any is a gap."""

    start_ns: int
    """Where the first stretch begins, ns since the epoch."""
    step_ns: int
    """How long a stretch is."""
    counts: tuple[int, ...]


@dataclass(slots=True)
class Timeline:
    """Counts of rows over time; times may come in any order."""

    step_ns: int = _FIRST_STEP_NS
    first: int = 0
    """The number of the first stretch, counted from the epoch."""
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def add(self, times_ns: NDArray[np.int64]) -> None:
        """Count rows at these times."""
        if not len(times_ns):
            return
        low, high = int(times_ns.min()) // self.step_ns, int(times_ns.max()) // self.step_ns
        if len(self.counts):
            low, high = min(low, self.first), max(high, self.first + len(self.counts) - 1)
        factor = 1
        while high // factor - low // factor >= MOST_STRETCHES:
            factor *= 2
        before = (np.arange(len(self.counts)) + self.first) // factor
        self.step_ns *= factor
        self.first = low // factor
        stretches = high // factor - self.first + 1
        counts = np.bincount(times_ns // self.step_ns - self.first, minlength=stretches)
        np.add.at(counts, before - self.first, self.counts)
        self.counts = counts

    def report(self) -> TimelineReport | None:
        """Return the counts as a report holds them; None where there is no row."""
        if not len(self.counts):
            return None
        counts = tuple(int(count) for count in self.counts)
        return TimelineReport(start_ns=self.first * self.step_ns, step_ns=self.step_ns, counts=counts)


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
