"""Logging of a run: lines for people or JSON for programs, on standard error."""

from __future__ import annotations

import json
import logging
import sys
import time
from datetime import datetime, timezone
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.report.events import (
    Event,
    Noted,
    RunFinished,
    RunStarted,
    TopicProgress,
    Unreadable,
)

if TYPE_CHECKING:
    from mosaico_ingest.cli.progress import Tally, Underway

__all__ = [
    "JsonLines",
    "LogFormat",
    "LogOption",
    "set_up_logging",
]

LogOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--log",
        "-l",
        help="DEBUG, INFO, WARNING, ERROR or CRITICAL; overrides run.log_level.",
        metavar="LEVEL",
    ),
]
"""How much a command with a manifest says."""


class LogFormat(str, Enum):
    """How lines are written."""

    TEXT = "text"
    JSON = "json"


PROGRESS_EVERY_S = 5.0


def set_up_logging(level: str, form: LogFormat = LogFormat.TEXT) -> None:
    """Send log records to standard error.

    Raises:
        ManifestError: There is no such level.
    """
    numeric = getattr(logging, level.upper(), None)
    if not isinstance(numeric, int):
        raise ManifestError(
            f"log level {level!r} is unknown", hint="use DEBUG, INFO, WARNING, ERROR or CRITICAL"
        )
    handler = logging.StreamHandler()
    handler.setFormatter(
        _JsonRecords() if form is LogFormat.JSON else logging.Formatter("%(levelname)s %(name)s: %(message)s")
    )
    logging.basicConfig(level=numeric, handlers=[handler], force=True)


class _JsonRecords(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        said = {"level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            said["traceback"] = self.formatException(record.exc_info)
        return _line("log", said)


class JsonLines:
    """An observer of a batch that writes a JSON object a line: what began, what is to know, how far, how it ended."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._next = time.monotonic() + PROGRESS_EVERY_S

    def __call__(self, position: int, event: Event) -> None:
        """Take one event."""
        before = self._tally.at_work.get(position)
        self._tally.add(position, event)
        known = self._tally.at_work.get(position, before)
        match event:
            case RunStarted():
                self._say(position, known, "started", files=event.files, source_bytes=event.source_bytes)
            case TopicProgress() if known is not None and time.monotonic() >= self._next:
                self._next = time.monotonic() + PROGRESS_EVERY_S
                self._say(position, known, "progress", read=known.read, batch=self._totals())
            case Noted():
                self._say(position, known, "note", message=str(event.finding))
            case Unreadable():
                lost = {"topic": event.target, "count": event.count, "message": event.reason}
                self._say(position, known, "unreadable", **lost)
            case RunFinished():
                counts = (
                    {"read": known.read, "rejected": known.rejected} if known else {"read": 0, "rejected": 0}
                )
                self._say(position, known, "finished", status=event.status.value, error=event.error, **counts)
            case _:
                pass

    def _totals(self) -> dict[str, Any]:
        """Return how far the whole is; `left_s` is null while nothing can be said."""
        tally = self._tally
        return {
            "recordings": tally.recordings,
            "done": tally.done,
            "failed": tally.failed,
            "in_work": [one.start.sequence for one in tally.at_work.values()],
            "read": tally.read,
            "rejected": tally.rejected,
            "payload_bytes": tally.payload_bytes,
            "elapsed_s": round(tally.elapsed_s, 3),
            "left_s": None if tally.left_s is None else round(tally.left_s, 3),
        }

    def _say(self, position: int, known: Underway | None, event: str, **more: Any) -> None:  # noqa: ANN401 - whatever JSON can say
        said = {"recording": position, "sequence": known.start.sequence if known else None, **more}
        sys.stderr.write(_line(event, said) + "\n")


def _line(event: str, said: dict[str, Any]) -> str:
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    return json.dumps({"time": now, "event": event, **said})
