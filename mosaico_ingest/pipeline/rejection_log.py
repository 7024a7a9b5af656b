"""Warnings about messages that cannot be decoded, for `on_error.message: log_warn`."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

from mosaico_ingest.findings import Stage
from mosaico_ingest.report.events import Event, Rejected, RunFinished
from mosaico_ingest.report.units import counted, time_text

WARNING_INTERVAL_S = 10.0
"""Least seconds between two warnings about one topic and rule."""

_log = logging.getLogger("mosaico_ingest.pipeline")


@dataclass(slots=True)
class _Pending:
    """Messages of one topic that broke one rule and have not been logged."""

    first: Rejected
    count: int
    next_at: float
    """Monotonic time from which the messages may be logged."""


@dataclass(slots=True)
class RejectionLog:
    """An observer that logs undecodable messages: the first of each topic and rule immediately, the others in groups."""

    sequence: str
    _pending: dict[tuple[str, str], _Pending] = field(default_factory=dict[tuple[str, str], _Pending])

    def __call__(self, event: Event) -> None:
        """Log or collect an event; the end of the run logs all pending events."""
        if isinstance(event, RunFinished):
            for pending in self._pending.values():
                self._flush(pending)
        elif isinstance(event, Rejected) and event.stage is Stage.DECODE:
            self._add(event)

    def _add(self, event: Rejected) -> None:
        key = (event.target, event.rule)
        pending = self._pending.get(key)
        now = time.monotonic()
        if pending is None:
            self._warn(event, event.count, "")
            self._pending[key] = _Pending(event, 0, now + WARNING_INTERVAL_S)
            return
        if not pending.count:
            pending.first = event
        pending.count += event.count
        if now >= pending.next_at:
            self._flush(pending)
            pending.next_at = now + WARNING_INTERVAL_S

    def _flush(self, pending: _Pending) -> None:
        if pending.count:
            self._warn(pending.first, pending.count, "more ")
            pending.count = 0

    def _warn(self, first: Rejected, count: int, more: str) -> None:
        _log.warning(
            "%s: %s cannot be decoded [%s]: %s (topic %s, first log time %s, offset %d)",
            self.sequence,
            counted(count, f"{more}message"),
            first.rule,
            first.reason,
            first.target,
            time_text(first.first_log_time_ns),
            first.first_offset,
        )
