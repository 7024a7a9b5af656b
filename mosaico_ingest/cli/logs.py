"""Logging of a run to standard error: lines for people, or JSON lines for programs."""

from __future__ import annotations

import json
import logging
import sys
from datetime import datetime, timezone
from enum import Enum
from typing import Any

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import one_line

LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


class LogFormat(str, Enum):
    """How log records and progress are written."""

    TEXT = "text"
    JSON = "json"


def set_up_logging(level: str, log_format: LogFormat = LogFormat.TEXT) -> None:
    """Send log records of this level and above to standard error.

    Raises:
        ManifestError: The level is unknown.
    """
    if level.upper() not in LEVELS:
        raise ManifestError(f"the log level {level!r} is unknown", hint=f"use one of {', '.join(LEVELS)}")
    handler = _StderrHandler()
    handler.setFormatter(_JsonFormatter() if log_format is LogFormat.JSON else _TextFormatter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def json_line(event: str, **values: Any) -> str:  # noqa: ANN401 - any JSON value
    """Return a JSON object with the current time, the name of the event and its values."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    return json.dumps({"time": now, "event": event, **values})


class _StderrHandler(logging.Handler):
    """Writes to the current `sys.stderr`, which the live display replaces while it runs."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            sys.stderr.write(self.format(record) + "\n")
        except Exception:  # noqa: BLE001 - a record that cannot be written must not end the run
            self.handleError(record)


class _TextFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line = one_line(f"{record.levelname} {record.name}: {record.getMessage()}")
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


class _JsonFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        values = {"level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            values["traceback"] = self.formatException(record.exc_info)
        return json_line("log", **values)
