"""The task of a Ray worker: ingest one recording, post its events to the mailbox, return the report."""

from __future__ import annotations

import logging
import pickle
import signal
import socket
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa
import ray
from msgspec import Struct

from mosaico_ingest.destinations.base import destination_of
from mosaico_ingest.errors import BagError, IngestError, Interrupted, SinkError
from mosaico_ingest.executors.batch import Registrations
from mosaico_ingest.interrupts import StopHandler
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.run import failed_report, run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import Event, RunFinished, RunStarted
from mosaico_ingest.report.model import Report

Notice: TypeAlias = tuple[int, int, Event | logging.LogRecord]
"""The position of the recording, the number of the attempt, and an event or a log record."""

_POST_INTERVAL_S = 0.2
"""Seconds between two posts to the mailbox."""


class Setting(Struct, frozen=True):
    """The settings that all tasks of a run share."""

    registrations: Registrations
    log_level: int
    beacon: str
    """The name of the file in the store by which a worker recognizes the driver's store."""
    machine: str
    """The id of the driver's machine; see `machine`."""


class Mailbox:
    """The actor on the driver's node that collects notices of workers until the driver fetches them."""

    def __init__(self) -> None:
        self._notices: list[Notice] = []

    def post(self, notices: list[Notice]) -> None:
        """Add notices of a worker."""
        self._notices += notices

    def fetch(self) -> list[Notice]:
        """Return the notices since the last call."""
        notices, self._notices = self._notices, []
        return notices


def ingest(
    pickled: bytes,
    position: int,
    attempt: int,
    mailbox: Any,  # noqa: ANN401 - Ray's handle of the actor
    setting: Setting,
) -> Report | IngestError:
    """Ingest one recording; return its report, or an error if the job cannot be read."""
    try:
        task: Task = pickle.loads(pickled)  # noqa: S301 - from our own driver
    except Exception as error:  # noqa: BLE001 - unpickling runs the code of the job's classes
        return IngestError(f"the job cannot be read on {_node()}: {type(error).__name__}: {error}")
    pa.set_cpu_count(1)
    setting.registrations.register()
    stop = StopHandler()
    outbox = _Outbox(mailbox, position, attempt, stop)
    before = signal.signal(signal.SIGINT, stop)  # Ray cancels a task by this signal
    try:
        with _records_sent(outbox, setting.log_level):
            report = _run(task, outbox, stop, setting)
        outbox.flush()
    finally:
        signal.signal(signal.SIGINT, before)
    return report


def _run(task: Task, outbox: _Outbox, stop: StopHandler, setting: Setting) -> Report:
    try:
        stop.enable()
        error = out_of_reach(task.job, setting)
        report = failed_report(task, error, outbox.tell) if error else run_recording(task, outbox.tell).report
    except KeyboardInterrupt:
        report = failed_report(task, Interrupted("stopped before the recording was opened"), outbox.tell)
    stop.disable()
    return report


def out_of_reach(job: Job, setting: Setting) -> IngestError | None:
    """Return an error if this node cannot access the recording or the store of the driver."""
    for path in job.paths:
        if isinstance(path, Path) and not path.exists():
            return BagError(
                f"the recording does not exist on the node {_node()}",
                where=str(path),
                hint="put recordings on storage that every node mounts at the same path, or name them by URL",
            )
    store = destination_of(job.destination).local_folder
    if store is None or (setting.machine == machine() and (store / setting.beacon).exists()):
        return None
    return SinkError(
        f"the node {_node()} cannot write to this store, whose catalog works on one machine only",
        where=str(store),
        hint="use a store at a URL such as s3://bucket/prefix, or a server",
    )


def machine() -> str:
    """Return an id of this machine; processes with the same id share memory, which the WAL of SQLite requires."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    return boot.read_text("ascii").strip() if boot.exists() else socket.gethostname()


def _node() -> str:
    return socket.gethostname()


class _Outbox:
    """Collects notices and posts them a few times per second."""

    def __init__(self, mailbox: Any, position: int, attempt: int, stop: StopHandler) -> None:  # noqa: ANN401 - Ray's handle
        self._mailbox = mailbox
        self._address = (position, attempt)
        self._stop = stop
        self._notices: list[Notice] = []
        self._posted_at = 0.0

    def tell(self, event: Event) -> None:
        """Add an event; an interrupt waits until it is posted."""
        self._stop.disable()
        self.put(event)
        urgent = isinstance(event, RunStarted | RunFinished)
        if urgent or time.monotonic() - self._posted_at > _POST_INTERVAL_S:
            self._post()
        self._stop.enable()

    def put(self, notice: Event | logging.LogRecord) -> None:
        """Add an event or a log record to the next post."""
        self._notices.append((*self._address, notice))

    def flush(self) -> None:
        """Post everything and wait for the delivery, so that no report arrives before its events."""
        ray.get(self._post())

    def _post(self) -> Any:  # noqa: ANN401 - Ray's reference
        notices, self._notices = self._notices, []
        self._posted_at = time.monotonic()
        return self._mailbox.post.remote(notices)


class _Records(logging.Handler):
    def __init__(self, outbox: _Outbox) -> None:
        super().__init__()
        self._outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        """Add a record with its message as text, because its arguments may not be picklable."""
        record.msg, record.args = record.getMessage(), None
        if record.exc_info:
            record.exc_text = logging.Formatter().formatException(record.exc_info)
            record.exc_info = None
        self._outbox.put(record)


@contextmanager
def _records_sent(outbox: _Outbox, level: int) -> Generator[None]:
    """Send log records to the driver, which logs them as its own."""
    root, handler = logging.getLogger(), _Records(outbox)
    before = root.level
    root.addHandler(handler)
    root.setLevel(level)
    try:
        yield
    finally:
        root.setLevel(before)
        root.removeHandler(handler)
