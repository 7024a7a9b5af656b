"""This file counts messages over time, in stretches that double whenever there would be too many of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.report.part import Part

__all__ = ["MOST_STRETCHES", "Timeline", "TimelineReport"]

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
