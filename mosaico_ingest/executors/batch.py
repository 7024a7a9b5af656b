"""What executors with other processes share: the bookkeeping of a batch, and the types and adapters that workers need."""

from __future__ import annotations

import uuid
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any

from msgspec import Struct

from mosaico_ingest.adapters.python import register_default_adapter, registered_adapters
from mosaico_ingest.errors import IngestError
from mosaico_ingest.executors.groups import may_join
from mosaico_ingest.job.values import Stores
from mosaico_ingest.pipeline.run import failed_report, run_recording
from mosaico_ingest.pipeline.task import Attempt, Task
from mosaico_ingest.report.events import BatchObserver, Event
from mosaico_ingest.report.model import Report
from mosaico_ingest.rosbag.definitions.registry import Registered, ROSTypeRegistry

_MAX_SKIPPED = 256
"""Number of recordings that are skipped before their reports are yielded."""


@dataclass(slots=True)
class Batch:
    """The recordings of a batch by position; every started recording gets exactly one report.

    Recordings are read from `source` one by one, so a batch may be of any size. Only recordings whose report has not been
    yielded are kept in memory.
    """

    source: Iterator[Task]
    observe: BatchObserver
    run: str = field(default_factory=lambda: uuid.uuid4().hex)
    """The id of the run, by which a later attempt recognizes what an earlier one committed."""
    tasks: dict[int, Task] = field(default_factory=dict[int, Task])
    """The recordings that were taken and have no report yet."""
    attempts: dict[int, int] = field(default_factory=dict[int, int])
    """The number of attempts of each of them."""
    exhausted: bool = False
    """Whether no recording is left to take."""
    _retries: deque[int] = field(default_factory=deque[int])
    """The recordings that were taken and have to start before others."""
    _reports: dict[int, Report] = field(default_factory=dict[int, Report])
    _started: int = 0
    _next: int = 0

    def take(self) -> int | None:
        """Return the position of a recording to start, or None if no recording can start now.

        Recordings that are known to be stored are skipped here, so that no worker is needed for them.
        """
        if self._retries:
            return self._retries.popleft()
        if self.exhausted:
            return None
        for task in islice(self.source, _MAX_SKIPPED):
            position, self._started = self._started, self._started + 1
            self.tasks[position] = task
            if not task.known:
                return position
            self.finish(position, run_recording(task, partial(self.observe, position)).report)
            if self._started - self._next >= _MAX_SKIPPED:
                return None
        self.exhausted = True
        return None

    def take_group(self, size: int) -> list[int]:
        """Return the positions of at most `size` recordings to start in one process, empty if none can start now.

        A recording that is large, depends on others, or was started before is alone.
        """
        group: list[int] = []
        while len(group) < size and (position := self.take()) is not None:
            is_alone = position in self.attempts or not may_join(self.tasks[position].job)
            if group and is_alone:
                self._retries.appendleft(position)
                break
            group.append(position)
            if is_alone:
                break
        return group

    def drop(self, positions: Iterable[int]) -> None:
        """Give up recordings that were not started; they have no report."""
        for position in positions:
            del self.tasks[position]

    def stop(self) -> None:
        """Take no more recordings."""
        self.exhausted = True
        self._retries.clear()

    @property
    def is_waiting(self) -> bool:
        """Whether recordings are left to take."""
        return bool(self._retries) or not self.exhausted

    def start(self, position: int) -> Attempt:
        """Count and return a new attempt."""
        number = self.attempts[position] = self.attempts.get(position, 0) + 1
        return Attempt(self.run, number)

    def tell(self, position: int, event: Event) -> None:
        """Pass an event of a recording to the observer."""
        self.observe(position, event)

    def finish(self, position: int, report: Report) -> None:
        """Store the report of a recording."""
        self._reports[position] = report
        del self.tasks[position]
        self.attempts.pop(position, None)

    def fail(self, position: int, error: IngestError) -> None:
        """Store the report of a recording that could not run."""
        self.finish(position, failed_report(self.tasks[position], error, partial(self.observe, position)))

    def retry(self, positions: Sequence[int]) -> None:
        """Start recordings again, before others."""
        self._retries.extendleft(reversed(positions))

    def reports(self) -> Iterator[Report]:
        """Yield the next reports in order, up to the first recording that is not finished."""
        while self._next in self._reports:
            yield self._reports.pop(self._next)
            self._next += 1

    def remaining_reports(self) -> Iterator[Report]:
        """Yield the reports behind recordings that will never finish."""
        for position in sorted(self._reports):
            yield self._reports.pop(position)


class Registrations(Struct, frozen=True):
    """The message types and adapters that were registered in a process; a new process starts without them."""

    types: Mapping[Stores | None, Mapping[str, Registered]]
    adapters: tuple[type[Any], ...]

    @classmethod
    def current(cls) -> Registrations:
        """Return the registrations of this process."""
        return cls(ROSTypeRegistry.snapshot(), tuple(dict.fromkeys(registered_adapters().values())))

    def register(self) -> None:
        """Register the types and adapters in this process."""
        ROSTypeRegistry.restore(self.types)
        for adapter in self.adapters:
            register_default_adapter(adapter)
