"""Executors: the configurations of many recordings in, one report per recording out.

An executor decides where `mosaico_ingest.pipeline` runs: in this process, in a pool of processes, or on a Ray cluster.
It must not decide how a recording is ingested, and it must not write to a terminal. This module has the interface and
choice of executors, the executor of this process, and the bookkeeping that executors share.
"""

from __future__ import annotations

import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from msgspec import Struct, field

from mosaico_ingest.adapters.python import register_default_adapter, registered_adapters
from mosaico_ingest.destinations import destination_of, keep_destinations_open
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.pipeline.run import failed_report, run_group, run_recording
from mosaico_ingest.pipeline.task import Attempt, Task
from mosaico_ingest.report.events import BatchObserver, Event, RunStatus
from mosaico_ingest.report.recording import Report
from mosaico_ingest.rosbag.definitions.registry import Registered, ROSTypeRegistry

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.job.values import Target
    from mosaico_ingest.remote import AnyPath

SMALL_BYTES = 4 << 20
"""Maximum size of a recording that joins others; a larger one might keep them waiting for their commit."""
_MAX_S = 0.25
"""Seconds after which no recording joins a group."""
_MAX_SKIPPED = 256
"""Number of recordings that are skipped before their reports are yielded."""


class Executor(Protocol):
    """Runs the recordings of a batch."""

    def map(self, tasks: Iterable[Task], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each task, in the order of the tasks; a failed recording does not stop the others.

        An interrupt ends the running recordings as their session policies demand. Recordings that were not started have
        no report.
        """
        ...


class InProcess:
    """The executor that runs recordings one after the other in this process."""

    def map(self, tasks: Iterable[Task], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each task; see `Executor.map`."""
        finished = 0
        with keep_destinations_open() as keep_open:
            for destination, tasks_of_group in commit_groups(tasks):
                if finished:
                    keep_open(destination)
                outcomes = run_group(tasks_of_group, partial(_observe_from, finished, observe))
                yield from (outcome.report for outcome in outcomes)
                if any(outcome.report.status is RunStatus.INTERRUPTED for outcome in outcomes):
                    return
                finished += len(outcomes)


def _observe_from(start: int, observe: BatchObserver, position: int, event: Event) -> None:
    observe(start + position, event)


def do_nothing() -> None:
    """Do nothing: the default preparation of a worker."""


def choose_executor(
    tasks: Sequence[Task],
    *,
    simultaneous: int | None = None,
    ray: bool = False,
    address: str | None = None,
    prepare: Callable[[], None] = do_nothing,
) -> Executor:
    """Return the executor for a batch: Ray if asked for, else worker processes, else this process.

    `simultaneous` is the number of recordings to run at the same time; it defaults to `run.jobs` of the first task.
    `address` is that of a Ray cluster; without it, Ray starts on this machine. Each worker process calls `prepare`
    first, for example to configure logging.

    Raises:
        IngestError: Ray is not installed.
    """
    if ray:
        from mosaico_ingest.executors.ray import Ray  # noqa: PLC0415 - an optional dependency

        return Ray(address, simultaneous)
    processes = min(simultaneous or tasks[0].job.run.jobs, len(tasks)) if tasks else 1
    if processes == 1:
        return InProcess()
    from mosaico_ingest.executors.processes import Processes  # noqa: PLC0415 - multiprocessing is slow to import

    return Processes(processes, prepare=prepare)


def commit_groups(tasks: Iterable[Task]) -> Iterator[tuple[Target, Iterator[Task]]]:
    """Yield the destination and the tasks of each group; a group ends while its tasks run, by their number or by time.

    The recordings of a group have the same destination, and none depends on what another one stores.
    """
    remaining = iter(tasks)
    following = next(remaining, None)

    def group(task: Task, destination: Target) -> Iterator[Task]:
        nonlocal following
        names = set[str]()
        end_s = time.monotonic() + _MAX_S
        limit = destination_of(destination).max_commits
        while True:
            names.add(task.job.sequence.name)
            yield task
            following = next(remaining, None)
            if following is None or len(names) == limit or time.monotonic() > end_s:
                return
            task, job = following, following.job
            if not may_join(job) or job.sequence.name in names or job.destination != destination:
                return

    while following is not None:
        destination = following.job.destination
        yield destination, group(following, destination)


def may_join(job: Job) -> bool:
    """Return whether a recording is small, and independent of the sequences that are stored before it."""
    if job.on_schema_change is not None or job.expect is not None:
        return False
    size = source_bytes(job)
    return size is not None and size <= SMALL_BYTES


def source_bytes(job: Job) -> int | None:
    """Return the size of the files of a recording, None if it is unknown."""
    with suppress(OSError, IngestError):
        sizes = [_size(path) for path in job.paths]
        return None if None in sizes else sum(size or 0 for size in sizes)
    return None


def _size(path: AnyPath) -> int | None:
    if not isinstance(path, Path):
        return None if path.listed is None else path.listed.st_size
    return sum(_size(part) or 0 for part in path.iterdir()) if path.is_dir() else path.stat().st_size


class Batch(Struct):
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
