"""The executor protocol, and the executor that runs recordings one after the other in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Protocol

from mosaico_ingest.destinations.registry import keep_destinations_open
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.run import run_config
from mosaico_ingest.report.events import BatchObserver, RunStatus
from mosaico_ingest.report.model import Report

__all__ = [
    "Executor",
    "Inline",
]


class Executor(Protocol):
    """Runs recordings somewhere."""

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each configuration, in their order; one that fails does not stop the others.

        An interrupt ends those in work as their session policies say; what had not begun has no report.
        """
        ...


class Inline:
    """The executor that needs nothing."""

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield a report for each configuration; see `Executor.map`."""
        with keep_destinations_open() as keep_open:
            for position, config in enumerate(configs):
                report = run_config(config, partial(observe, position))
                yield report
                if report.status is RunStatus.INTERRUPTED:
                    return
                if position + 1 < len(configs):
                    keep_open(config.target)
