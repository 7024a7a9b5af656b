"""This file is the task on a node of a Ray cluster: it ingests one recording, sends events to the mailbox, returns the report."""

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

from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.errors import (
    BagError,
    IngestError,
    Interrupted,
    SinkError,
)
from mosaico_ingest.executors.processes import Registrations
from mosaico_ingest.interrupts import Stop
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.run import failed_report, run_config
from mosaico_ingest.report.events import Event, RunFinished, RunStarted
from mosaico_ingest.report.model import Report

__all__ = ["Mailbox", "Notice", "Setting", "ingest", "machine", "out_of_reach"]

Notice: TypeAlias = tuple[int, int, Event | logging.LogRecord]
"""The recording's position, the number of the attempt, what there is to say."""

_SEND_EVERY_S = 0.2


class Setting(Struct, frozen=True):
    """What all tasks of a run have in common."""

    registrations: Registrations
    log_level: int
    beacon: str
    """The name of the file by which a worker knows that it sees the same store as the driver."""
    machine: str
    """Where the driver runs."""


class Mailbox:
    """The actor beside the driver that takes in what workers say until it is fetched; the driver asks, so that it never waits."""

    def __init__(self) -> None:
        self._notices: list[Notice] = []

    def post(self, notices: list[Notice]) -> None:
        """Take in what workers have to say."""
        self._notices += notices

    def fetch(self) -> list[Notice]:
        """Hand out what has come in."""
        notices, self._notices = self._notices, []
        return notices


def ingest(
    pickled: bytes,
    position: int,
    attempt: int,
    mailbox: Any,  # noqa: ANN401 - Ray's handle of the actor
    setting: Setting,
) -> Report | IngestError:
    """Ingest one recording; what cannot even be begun is an error."""
    try:
        config: ROSInjectionConfig = pickle.loads(pickled)  # noqa: S301 - from our own driver
    except Exception as error:  # noqa: BLE001 - the border: a class's own code runs here
        return IngestError(f"the job cannot be read on {_node()}: {type(error).__name__}: {error}")
    pa.set_cpu_count(1)
    setting.registrations.register()
    stop = Stop()
    outbox = _Outbox(mailbox, position, attempt, stop)
    before = signal.signal(signal.SIGINT, stop)  # what Ray's cancellation raises
    try:
        with _records_sent(outbox, setting.log_level):
            report = _run(config, outbox, stop, setting)
        outbox.flush()
    finally:
        signal.signal(signal.SIGINT, before)
    return report


def _run(config: ROSInjectionConfig, outbox: _Outbox, stop: Stop, setting: Setting) -> Report:
    try:
        stop.heed()
        blind = out_of_reach(config, setting)
        report = failed_report(config, blind, outbox.tell) if blind else run_config(config, outbox.tell)
    except KeyboardInterrupt:
        report = failed_report(config, Interrupted("stopped before it was begun"), outbox.tell)
    stop.hold()
    return report


def out_of_reach(config: ROSInjectionConfig, setting: Setting) -> IngestError | None:
    """Return what is wrong where this node cannot use the files that the driver uses."""
    for path in config.paths:
        if isinstance(path, Path) and not path.exists():
            return BagError(
                f"the node {_node()} does not see the recording",
                where=str(path),
                hint="put recordings on storage that every node mounts at the same place, or name them by URL",
            )
    store = destination_of(config.target).local_folder
    if store is None or (setting.machine == machine() and (store / setting.beacon).exists()):
        return None
    return SinkError(
        f"the node {_node()} cannot write to this store: its catalog works on one machine only",
        where=str(store),
        hint="use a store behind a URL, as s3://bucket/prefix, or a server",
    )


def machine() -> str:
    """Return what differs from machine to machine: processes that share it share memory, as SQLite's WAL needs."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    return boot.read_text("ascii").strip() if boot.exists() else socket.gethostname()


def _node() -> str:
    return socket.gethostname()


class _Outbox:
    """Collects what there is to say and posts it a few times a second."""

    def __init__(self, mailbox: Any, position: int, attempt: int, stop: Stop) -> None:  # noqa: ANN401 - Ray's handle
        self._mailbox = mailbox
        self._address = (position, attempt)
        self._stop = stop
        self._notices: list[Notice] = []
        self._posted_at = 0.0

    def tell(self, event: Event) -> None:
        """Take an event; an interrupt is not let through while it is sent."""
        self._stop.hold()
        self.put(event)
        urgent = isinstance(event, RunStarted | RunFinished)
        if urgent or time.monotonic() - self._posted_at > _SEND_EVERY_S:
            self._post()
        self._stop.heed()

    def put(self, said: Event | logging.LogRecord) -> None:
        """Take something that goes with the next event."""
        self._notices.append((*self._address, said))

    def flush(self) -> None:
        """Post everything and wait until it is there, so that no report comes before its events."""
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
        """Send a record as text: what it was made from may not travel."""
        record.msg, record.args = record.getMessage(), None
        if record.exc_info:
            record.exc_text = logging.Formatter().formatException(record.exc_info)
            record.exc_info = None
        self._outbox.put(record)


@contextmanager
def _records_sent(outbox: _Outbox, level: int) -> Generator[None]:
    """Send what is logged to the driver, which shows it as its own."""
    root, handler = logging.getLogger(), _Records(outbox)
    before = root.level
    root.addHandler(handler)
    root.setLevel(level)
    try:
        yield
    finally:
        root.setLevel(before)
        root.removeHandler(handler)
