"""This file is `--otel`: what a run does is told to an OpenTelemetry collector too."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager

from mosaico_ingest.report.events import BatchObserver, ignore_batch

__all__ = ["telemetry"]


@contextmanager
def telemetry(wanted: bool) -> Generator[BatchObserver]:
    """Yield the observer that sends metrics and traces, each unless the environment says `none`.

    Raises:
        IngestError: OpenTelemetry is not installed.
    """
    if not wanted:
        yield ignore_batch
        return
    from mosaico_ingest.report.telemetry import Telemetry

    sender = Telemetry(metrics=_is_on("OTEL_METRICS_EXPORTER"), traces=_is_on("OTEL_TRACES_EXPORTER"))
    try:
        yield sender
    finally:
        sender.close()


def _is_on(variable: str) -> bool:
    return os.environ.get(variable, "") != "none"
