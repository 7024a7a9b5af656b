"""The interface of an executor, the executor that runs in this process, and the choice of an executor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Protocol

from mosaico_ingest.report.events import RunStatus

if TYPE_CHECKING:
    from mosaico_ingest.pipeline.task import Task
    from mosaico_ingest.report.events import BatchObserver, Event
    from mosaico_ingest.report.model import Report


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
        from mosaico_ingest.destinations.base import keep_destinations_open  # noqa: PLC0415 - choosing an executor must not load it
        from mosaico_ingest.executors.groups import commit_groups  # noqa: PLC0415 - the same
        from mosaico_ingest.pipeline.run import run_group  # noqa: PLC0415 - choosing an executor must not load the pipeline

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
