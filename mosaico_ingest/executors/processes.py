"""The executor that runs recordings in a pool of worker processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.python import register_default_adapter, registered_adapters
from mosaico_ingest.destinations.registry import KeepOpen, keep_destinations_open
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors.batch import Batch
from mosaico_ingest.interrupts import Stop, counted_interrupts
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import Stores
from mosaico_ingest.pipeline.plan import DEFAULT_MEMORY_BYTES
from mosaico_ingest.pipeline.run import failed_report, run_config
from mosaico_ingest.report.events import BatchObserver, Event
from mosaico_ingest.report.model import Report
from mosaico_ingest.rosbag.definitions.registry import Registered, ROSTypeRegistry

__all__ = [
    "Processes",
    "Registrations",
    "do_nothing",
    "work",
]


class Registrations(Struct, frozen=True):
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
    with keep_destinations_open() as keep_open, suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while not stop.asked:
            _ingest(pipe, pipe.recv_bytes(), stop, keep_open)


def _ingest(pipe: Connection, pickled: bytes, stop: Stop, keep_open: KeepOpen) -> None:
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
    keep_open(config.target)


ATTEMPTS = 2
"""How often a recording is begun whose process died under it."""
_SHUTDOWN_S = 10.0
_POLL_S = 0.2
"""How long a request to stop may go unnoticed."""
_LEAST_BYTES = 32 << 20


class Processes(Struct, frozen=True):
    """The executor for one machine: at most `jobs` recordings at a time, each in a process of its own.

    A process that dies takes only its recording with it, which is begun anew up to `attempts` times. The jobs' memory
    is shared out. `prepare` is called in every process first, where logging is to be set up.
    """

    jobs: int
    attempts: int = ATTEMPTS
    prepare: Callable[[], None] = do_nothing

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each configuration; see `Executor.map`."""
        jobs = max(1, min(self.jobs, len(configs)))
        shared = [replace(config, memory_bytes=_share(config.memory_bytes, jobs)) for config in configs]
        pool = _Pool(Batch(shared, observe), jobs, self.attempts, partial(_start, self.prepare, jobs))
        with counted_interrupts() as interrupts:
            try:
                yield from pool.reports(interrupts)
            finally:
                pool.shut_down()


@dataclass(slots=True)
class _Worker:
    """A process, our end of the pipe to it, and the recording it has in work."""

    process: SpawnProcess
    pipe: Connection
    task: int | None = None


@dataclass(slots=True)
class _Pool:
    batch: Batch
    jobs: int
    attempts: int
    spawn: Callable[[], _Worker]
    workers: list[_Worker] = field(default_factory=list[_Worker])
    interrupted: int = 0

    def reports(self, interrupts: list[int]) -> Iterator[Report]:
        """Yield reports in order, as soon as those before them are there too."""
        while self.batch.waiting or any(worker.task is not None for worker in self.workers):
            self._assign()
            self._poll()
            if len(interrupts) > self.interrupted:
                self._interrupt()
            yield from self.batch.reports()
        yield from self.batch.rest()

    def shut_down(self) -> None:
        """End every process: the idle by closing their pipes, one still at work by interrupting it."""
        for worker in self.workers:
            if worker.task is not None:
                _signal(worker, signal.SIGINT)
            worker.pipe.close()
        for worker in self.workers:
            worker.process.join(_SHUTDOWN_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _assign(self) -> None:
        while self.batch.waiting:
            worker = next((worker for worker in self.workers if worker.task is None), None)
            if worker is None:
                if len(self.workers) == self.jobs:
                    return
                worker = self.spawn()
                self.workers.append(worker)
            self._send(worker, self.batch.waiting.popleft())

    def _send(self, worker: _Worker, task: int) -> None:
        try:
            pickled = ForkingPickler.dumps(replace(self.batch.configs[task], attempt=self.batch.begin(task)))
        except Exception as error:  # noqa: BLE001 - pickle raises what the object's class raises
            self.batch.fail(task, _unsendable(error))
            return
        worker.task = task
        with suppress(BrokenPipeError):  # a process that is gone is noticed where we listen
            worker.pipe.send_bytes(pickled)

    def _poll(self) -> None:
        at_work = [worker.pipe for worker in self.workers if worker.task is not None]
        ready = set(wait(at_work, _POLL_S)) if at_work else set[object]()
        for worker in self.workers[:]:
            if worker.task is not None and worker.pipe in ready:
                self._receive(worker, worker.task)

    def _receive(self, worker: _Worker, task: int) -> None:
        try:
            message = worker.pipe.recv()
        except (EOFError, OSError):
            self._worker_died(worker, task)
            return
        if isinstance(message, Report):
            worker.task = None
            self.batch.finish(task, message)
        elif isinstance(message, IngestError):
            worker.task = None
            self.batch.fail(task, message)
        else:
            self.batch.tell(task, message)

    def _worker_died(self, worker: _Worker, task: int) -> None:
        """Account for a process that died: its recording is begun anew, or has failed."""
        worker.process.join()
        worker.pipe.close()
        self.workers.remove(worker)
        if self.interrupted:
            self.batch.fail(task, Interrupted("stopped before the end of the recording"))
        elif self.batch.begun[task] < self.attempts:
            self.batch.again(task)
        else:
            self.batch.fail(task, _died(worker.process.exitcode, self.attempts))

    def _interrupt(self) -> None:
        """Begin nothing more and let what is in work end as its policy says; asked twice, end it at once."""
        self.batch.waiting.clear()
        for worker in self.workers:
            if worker.task is not None:
                _signal(worker, signal.SIGKILL if self.interrupted else signal.SIGINT)
        self.interrupted += 1


def _start(prepare: Callable[[], None], jobs: int) -> _Worker:
    spawning = multiprocessing.get_context("spawn")  # threads run here, so forking would be a gamble
    ours, theirs = spawning.Pipe()
    try:
        process = spawning.Process(
            target=work,
            args=(theirs, Registrations.current(), prepare, jobs),
            name="ingest-worker",
            daemon=True,
        )
        process.start()
    except Exception as error:
        ours.close()
        raise _unsendable(error) from error
    finally:
        theirs.close()
    return _Worker(process, ours)


def _share(memory_bytes: int | None, jobs: int) -> int:
    return max((memory_bytes or DEFAULT_MEMORY_BYTES) // jobs, _LEAST_BYTES)


def _signal(worker: _Worker, number: signal.Signals) -> None:
    if worker.process.pid is not None and worker.process.is_alive():
        os.kill(worker.process.pid, number)


def _unsendable(error: Exception) -> IngestError:
    return IngestError(
        f"the job cannot be sent to another process: {error}",
        hint="define its adapters at the top level of a module, or run with one job",
    )


def _died(exit_code: int | None, attempts: int) -> IngestError:
    if exit_code is not None and exit_code < 0:
        how = f"was killed by {signal.Signals(-exit_code).name}"
    else:
        how = f"ended with exit code {exit_code}"
    memory = exit_code == -signal.SIGKILL
    return IngestError(
        f"the process that ingested it {how}, {attempts} times in all",
        hint="memory may have run out: give fewer jobs or less run.memory" if memory else None,
    )
