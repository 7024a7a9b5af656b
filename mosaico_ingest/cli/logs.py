"""This file sets up what the program says while it runs: lines for people, or JSON for programs, on standard error."""

from __future__ import annotations

import json
import logging
import sys
import time
from datetime import datetime, timezone
from typing import Any

from mosaico_ingest.cli.log_format import LogFormat
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.report.events import (
    Event,
    Noted,
    Rejected,
    RunFinished,
    RunStarted,
    TopicProgress,
    Unreadable,
)

__all__ = ["JsonLines", "set_up_logging"]

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

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        self._read: dict[int, int] = {}
        self._rejected: dict[int, int] = {}
        self._next = time.monotonic() + PROGRESS_EVERY_S

    def __call__(self, position: int, event: Event) -> None:
        """Take one event."""
        match event:
            case RunStarted():
                self._names[position] = event.sequence
                self._read[position] = self._rejected[position] = 0
                self._say(position, "started", files=event.files, source_bytes=event.source_bytes)
            case TopicProgress():
                self._read[position] += event.read
                if time.monotonic() >= self._next:
                    self._next = time.monotonic() + PROGRESS_EVERY_S
                    self._say(position, "progress", read=self._read[position])
            case Rejected():
                self._rejected[position] += event.count
            case Noted():
                self._say(position, "note", message=str(event.finding))
            case Unreadable():
                self._say(position, "unreadable", topic=event.target, count=event.count, message=event.reason)
            case RunFinished():
                counts = {"read": self._read.get(position, 0), "rejected": self._rejected.get(position, 0)}
                self._say(position, "finished", status=event.status.value, error=event.error, **counts)
            case _:
                pass

    def _say(self, position: int, event: str, **more: Any) -> None:  # noqa: ANN401 - whatever JSON can say
        said = {"recording": position, "sequence": self._names.get(position), **more}
        sys.stderr.write(_line(event, said) + "\n")


def _line(event: str, said: dict[str, Any]) -> str:
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    return json.dumps({"time": now, "event": event, **said})
