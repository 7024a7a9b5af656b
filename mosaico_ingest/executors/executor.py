"""This file is the executor's seam: configurations in, their reports out, in the same order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.report.events import BatchObserver
from mosaico_ingest.report.model import Report

__all__ = ["Executor"]


class Executor(Protocol):
    """Runs recordings somewhere."""

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each configuration, in their order; one that fails does not stop the others.

        An interrupt ends those in work as their session policies say; what had not begun has no report.
        """
        ...
