"""Settings of the process: signals, garbage collection, memory, the import of pandas, and logging."""

from __future__ import annotations

import gc
import json
import logging
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timezone
from enum import Enum
from importlib.machinery import ModuleSpec
from types import FrameType
from typing import TYPE_CHECKING, Any

from mosaico_ingest.errors import AdapterError, ManifestError
from mosaico_ingest.findings import one_line
from mosaico_ingest.lazy import LazySequence

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job

DEFAULT_THRESHOLD = gc.get_threshold()
IMPORT_THRESHOLD = 500_000
"""Allocations between two collections during start-up: more than all imports make."""
M_ARENA_MAX = -8
"""glibc's parameter for the maximum number of heaps."""
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")


def interrupt_on_sigterm() -> None:
    """Treat SIGTERM like Ctrl-C, so that the session policy applies to both."""
    signal.signal(signal.SIGTERM, _interrupt)


def exit_on_signals() -> None:
    """Let SIGTERM and SIGINT end the process without a traceback, once all work is done."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def defer_garbage_collection() -> None:
    """Collect garbage rarely during start-up: imports produce none, and looking for it took 12 % of the time."""
    gc.set_threshold(IMPORT_THRESHOLD, *DEFAULT_THRESHOLD[1:])


def collect_garbage_as_usual() -> None:
    """Restore the default thresholds, and exclude all imported objects from collection.

    Without the exclusion, the collection at exit alone takes 70 ms.
    """
    gc.freeze()
    gc.set_threshold(*DEFAULT_THRESHOLD)


def set_up_worker(level: str, log_format: LogFormat, *, python_adapters: bool) -> None:
    """Set up logging, garbage collection and the import of pandas in a worker process, as in its parent."""
    set_up_logging(level, log_format)
    if not python_adapters:
        hide_pandas()
    collect_garbage_as_usual()


def hide_pandas(jobs: Sequence[Job] = ()) -> None:
    """Make pyarrow conclude that pandas is absent, unless Python adapters run, which may return series.

    pyarrow imports pandas with the first array, which takes longer than a short run. Programs can still import
    pandas afterwards; only pyarrow no longer recognizes its objects inside lists.
    """
    if (
        "pandas" in sys.modules
        or any(map(uses_python_adapters, LazySequence.of(jobs).samples))
        or _has_installed_adapters()
    ):
        return
    import numpy as np
    import pyarrow as pa

    sys.meta_path.insert(0, _NoPandas)
    try:
        pa.array(np.zeros(1))
        pa.array([0])
    finally:
        sys.meta_path.remove(_NoPandas)


def limit_heaps(count: int = 2) -> None:
    """Let all threads share a few heaps, so that a server's short-lived threads do not keep one each.

    On other C libraries than glibc, only the memory pool of Arrow changes.
    """
    import ctypes

    import pyarrow as pa

    pa.set_memory_pool(pa.system_memory_pool())
    with suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no default library
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, count)


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


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


class _NoPandas:
    """An import hook that hides pandas and leaves every other module to the next hook."""

    @staticmethod
    def find_spec(name: str, *_arguments: object) -> ModuleSpec | None:
        if name == "pandas":
            raise ModuleNotFoundError(name)
        return None


def uses_python_adapters(job: Job) -> bool:
    """Return whether a job names adapters in Python."""
    from mosaico_ingest.job.fields import reference_of

    references = map(reference_of, (*job.adapters.load, *job.adapters.override.values()))
    return any(not str(reference).endswith((".yaml", ".yml")) for reference in references)


def _has_installed_adapters() -> bool:
    from mosaico_ingest.adapters.bridge import installed_adapters

    try:
        return bool(installed_adapters())
    except AdapterError:
        return True  # the run reports the error when it uses them


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
