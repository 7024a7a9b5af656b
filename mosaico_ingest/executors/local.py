"""This file runs configurations one after the other in this process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.executors.held import held_catalogs
from mosaico_ingest.executors.worker import run_config
from mosaico_ingest.report.events import BatchObserver, RunStatus
from mosaico_ingest.report.model import Report

__all__ = ["Inline"]


class Inline:
    """The executor that needs nothing."""

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield a report for each configuration; see `Executor.map`."""
        with held_catalogs() as hold:
            for position, config in enumerate(configs):
                report = run_config(config, partial(observe, position))
                yield report
                if report.status is RunStatus.INTERRUPTED:
                    return
                if position + 1 < len(configs):
                    hold(config.target)
