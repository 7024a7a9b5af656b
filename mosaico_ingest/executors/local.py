"""This file runs configurations one after the other in this process."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.executors.worker import run_config
from mosaico_ingest.report.events import Observer
from mosaico_ingest.report.model import Report

__all__ = ["run_all"]


def run_all(configs: Iterable[ROSInjectionConfig], observe: Observer) -> Iterator[Report]:
    """Yield a report for each configuration; one that fails does not stop the next, an interrupt does."""
    for config in configs:
        report = run_config(config, observe)
        yield report
        if report.exit_code == INTERRUPTED:
            return


INTERRUPTED = 130
