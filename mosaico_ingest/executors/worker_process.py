"""This file is what a worker process does: recordings come in through a pipe, events and reports go out."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import pyarrow as pa

from mosaico_ingest.adapters.base import register_default_adapter, registered_adapters
from mosaico_ingest.bag.registry import Registered, ROSTypeRegistry
from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors.held import Hold, held_catalogs
from mosaico_ingest.executors.worker import failed_report, run_config
from mosaico_ingest.frozen import frozen
from mosaico_ingest.interrupts import Stop
from mosaico_ingest.policies import Stores
from mosaico_ingest.report.events import Event

__all__ = ["Registrations", "do_nothing", "work"]


@frozen
class Registrations:
    """The types and adapters a program has registered, which a new process does not know of."""

    types: Mapping[Stores | None, Mapping[str, Registered]]
    adapters: tuple[type[Any], ...]

    @classmethod
    def current(cls) -> Registrations:
        """Return those of this process."""
        return cls(ROSTypeRegistry.snapshot(), tuple(dict.fromkeys(registered_adapters().values())))

    def register(self) -> None:
        """Register them in this process."""
        ROSTypeRegistry.restore(self.types)
        for adapter in self.adapters:
            register_default_adapter(adapter)


def do_nothing() -> None:
    """Prepare nothing."""


def work(pipe: Connection, registrations: Registrations, prepare: Callable[[], None], jobs: int) -> None:
    """Ingest what comes through the pipe until its other end is closed."""
    os.setsid()  # Ctrl-C reaches the parent only, which passes it on once
    stop = Stop()
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    pa.set_cpu_count(max(1, (os.cpu_count() or 1) // jobs))
    prepare()
    registrations.register()
    with held_catalogs() as hold, suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while not stop.asked:
            _ingest(pipe, pipe.recv_bytes(), stop, hold)


def _ingest(pipe: Connection, pickled: bytes, stop: Stop, hold: Hold) -> None:
    def tell(event: Event) -> None:
        stop.hold()  # an interrupt in the middle of a message would leave half of it in the pipe
        pipe.send(event)
        stop.heed()

    try:
        config: ROSInjectionConfig = pickle.loads(pickled)  # noqa: S301 - from our own parent
    except Exception as error:  # noqa: BLE001 - the border: a class's own code runs here
        pipe.send(IngestError(f"the job cannot be read in another process: {type(error).__name__}: {error}"))
        return
    try:
        stop.heed()
        report = run_config(config, tell)
    except KeyboardInterrupt:
        report = failed_report(config, Interrupted("stopped before it was begun"), tell)
    stop.hold()
    pipe.send(report)
    hold(config.target)
