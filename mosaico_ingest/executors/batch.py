"""This file tracks a batch whose recordings run in other processes: which wait, how often each was begun, which are done."""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.config import Attempt, ROSInjectionConfig
from mosaico_ingest.pipeline.run import failed_report
from mosaico_ingest.report.events import BatchObserver, Event
from mosaico_ingest.report.model import Report

__all__ = ["Batch"]


@dataclass(slots=True)
class Batch:
    """Recordings by their position; every one gets exactly one report, unless it was never begun."""

    configs: Sequence[ROSInjectionConfig]
    observe: BatchObserver
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    waiting: deque[int] = field(default_factory=deque[int])
    begun: dict[int, int] = field(default_factory=dict[int, int])
    """How often a recording was begun."""
    _done: dict[int, Report] = field(default_factory=dict[int, Report])
    _next: int = 0

    def __post_init__(self) -> None:
        """Let every recording wait."""
        self.waiting.extend(range(len(self.configs)))

    def begin(self, position: int) -> Attempt:
        """Count an attempt."""
        number = self.begun[position] = self.begun.get(position, 0) + 1
        return Attempt(self.run, number)

    def tell(self, position: int, event: Event) -> None:
        """Pass on what happens to a recording."""
        self.observe(position, event)

    def finish(self, position: int, report: Report) -> None:
        """Take a recording's report."""
        self._done[position] = report

    def fail(self, position: int, error: IngestError) -> None:
        """Report that nothing came of a recording."""
        self.finish(position, failed_report(self.configs[position], error, partial(self.observe, position)))

    def again(self, position: int) -> None:
        """Let a recording be the next to begin."""
        self.waiting.appendleft(position)

    def reports(self) -> Iterator[Report]:
        """Yield what is done, in order, as far as those before it are done too."""
        while self._next in self._done:
            yield self._done.pop(self._next)
            self._next += 1

    def rest(self) -> Iterator[Report]:
        """Yield what is done although something before it never will be."""
        for position in sorted(self._done):
            yield self._done.pop(position)
