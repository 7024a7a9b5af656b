"""The executor that runs recordings one after the other in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from mosaico_ingest.destinations.registry import keep_destinations_open
from mosaico_ingest.pipeline.run import run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import BatchObserver, RunStatus
from mosaico_ingest.report.model import Report


class InProcess:
    """Runs recordings one after the other in this process."""

    def map(self, tasks: Sequence[Task], observe: BatchObserver) -> Iterator[Report]:
        """Yield a report for each task; see `Executor.map`."""
        with keep_destinations_open() as keep_open:
            for position, task in enumerate(tasks):
                report = run_recording(task, partial(observe, position)).report
                yield report
                if report.status is RunStatus.INTERRUPTED:
                    return
                if position + 1 < len(tasks):
                    keep_open(task.job.destination)
