"""The executor that runs recordings in a pool of worker processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain, islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler

import pyarrow as pa
from msgspec import Struct, field, structs

from mosaico_ingest.destinations import KeepOpen, keep_destinations_open
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors import Batch, InProcess, Registrations, do_nothing
from mosaico_ingest.interrupts import StopHandler, count_interrupts
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.run import failed_report
from mosaico_ingest.pipeline.task import MemoryBudget, Task
from mosaico_ingest.report.events import BatchObserver, Event
from mosaico_ingest.report.recording import Report

ATTEMPTS = 2
"""Number of times a recording is started if its worker process dies."""
_SHUTDOWN_S = 10.0
"""Seconds that a worker has to end before it is killed."""
_MAX_GROUP = 32
"""Maximum number of recordings that a worker receives at a time."""
_POLL_S = 0.2
"""Seconds between two checks for a request to stop."""
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SIGKILL = 9
"""`signal.SIGKILL`, which Windows does not define."""


class Processes(Struct, frozen=True):
    """The executor for one machine: up to `processes` recordings at a time, each in a worker process.

    A worker receives several small recordings at a time, which it commits together; the number doubles from one group to
    the next, so that all workers end at about the same time. If a worker dies, its recordings are started again, each
    alone and up to `attempts` times in total; other recordings are not affected. The memory budget of the jobs is split
    among the workers. Each worker calls `prepare` first, for example to configure logging.
    """

    processes: int
    attempts: int = ATTEMPTS
    prepare: Callable[[], None] = do_nothing

    def map(self, tasks: Iterable[Task], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each task; see `Executor.map`."""
        remaining = iter(tasks)
        first = list(islice(remaining, self.processes))  # fewer tasks need fewer processes
        processes = max(1, len(first))
        split = (
            structs.replace(task, job=_split_memory(task.job, processes)) for task in chain(first, remaining)
        )
        spawn = partial(_spawn_worker, self.prepare, processes)
        pool = _Pool(Batch(split, observe), processes, self.attempts, spawn)
        with count_interrupts() as interrupts:
            try:
                yield from pool.reports(interrupts)
            finally:
                pool.shut_down()


class _Worker(Struct):
    """A worker process, the parent's end of its pipe, and the recordings it runs."""

    process: SpawnProcess
    pipe: Connection
    group_size: int = 1
    """Maximum number of recordings that it receives next."""
    group: tuple[int, ...] = ()
    """The positions of the recordings that it received, empty if it is idle."""
    unfinished: dict[int, bool] = field(default_factory=dict[int, bool])
    """The positions of those without a report, in order, and whether they were started."""


class _Pool(Struct):
    batch: Batch
    size: int
    attempts: int
    spawn: Callable[[], _Worker]
    workers: list[_Worker] = field(default_factory=list[_Worker])
    interrupts: int = 0
    """Number of interrupts that were passed on to the workers."""

    def reports(self, interrupts: list[int]) -> Iterator[Report]:
        """Yield reports in order, each as soon as the ones before it are finished."""
        while self.batch.is_waiting or any(worker.group for worker in self.workers):
            self._assign()
            self._poll()
            if len(interrupts) > self.interrupts:
                self._interrupt()
            yield from self.batch.reports()
        yield from self.batch.remaining_reports()

    def shut_down(self) -> None:
        """End every worker: idle ones by closing their pipes, busy ones by an interrupt."""
        for worker in self.workers:
            if worker.group:
                _signal(worker, signal.SIGINT)
            worker.pipe.close()
        for worker in self.workers:
            worker.process.join(_SHUTDOWN_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _assign(self) -> None:
        while len(self.workers) < self.size or any(not worker.group for worker in self.workers):
            worker = next((worker for worker in self.workers if not worker.group), None)
            group = self.batch.take_group(1 if worker is None else worker.group_size)
            if not group:
                return
            if worker is None:
                worker = self.spawn()
                self.workers.append(worker)
            self._send(worker, group)

    def _send(self, worker: _Worker, group: Sequence[int]) -> None:
        tasks = [
            structs.replace(self.batch.tasks[position], attempt=self.batch.start(position))
            for position in group
        ]
        try:
            pickled = ForkingPickler.dumps(tasks)
        except Exception as error:  # noqa: BLE001 - pickling runs the code of the job's classes
            self._separate(group, _unsendable(error))
            return
        worker.group = tuple(group)
        worker.unfinished = dict.fromkeys(group, False)
        worker.group_size = min(2 * worker.group_size, _MAX_GROUP)
        with suppress(BrokenPipeError):  # `_receive` notices that the process is gone
            worker.pipe.send_bytes(pickled)

    def _poll(self) -> None:
        busy = [worker.pipe for worker in self.workers if worker.group]
        is_skipping = len(busy) < self.size and not self.batch.exhausted
        ready = set(wait(busy, 0 if is_skipping else _POLL_S)) if busy else set[object]()
        for worker in self.workers[:]:
            if worker.group and worker.pipe in ready:
                self._receive(worker)

    def _receive(self, worker: _Worker) -> None:
        try:
            message = worker.pipe.recv()
        except (EOFError, OSError):
            self._handle_death(worker)
            return
        if isinstance(message, IngestError):
            self._separate(worker.group, message)
            worker.group = ()
        elif message is None:
            self._handle_end(worker)
        else:
            number, content = message
            position = worker.group[number]
            if isinstance(content, Report):
                del worker.unfinished[position]
                self.batch.finish(position, content)
            else:
                worker.unfinished[position] = True
                self.batch.tell(position, content)

    def _separate(self, group: Sequence[int], error: IngestError) -> None:
        """Send the recordings of a group one by one, because the group cannot be pickled; a single recording fails."""
        if len(group) == 1:
            self.batch.fail(group[0], error)
        else:
            self.batch.retry(group)

    def _handle_end(self, worker: _Worker) -> None:
        """Make a worker idle; an interrupted worker does not start all recordings of its group."""
        if self.interrupts:
            self.batch.drop(worker.unfinished)
        else:
            self.batch.retry(tuple(worker.unfinished))
        worker.group = ()

    def _handle_death(self, worker: _Worker) -> None:
        """Remove a worker that died; start its recordings again one by one, or report them as failed."""
        worker.process.join()
        worker.pipe.close()
        self.workers.remove(worker)
        for position, is_started in reversed(worker.unfinished.items()):
            if self.interrupts and is_started:
                self.batch.fail(position, Interrupted("stopped before the end of the recording"))
            elif self.interrupts:
                self.batch.drop([position])
            elif len(worker.group) > 1 or self.batch.attempts[position] < self.attempts:
                self.batch.retry([position])
            else:
                self.batch.fail(position, _worker_died(worker.process.exitcode, self.attempts))

    def _interrupt(self) -> None:
        """Start no more recordings and interrupt the running ones; a second interrupt kills them."""
        self.batch.stop()
        for worker in self.workers:
            if worker.group:
                if self.interrupts:
                    worker.process.kill()
                else:
                    _signal(worker, signal.SIGINT)
        self.interrupts += 1


def work(pipe: Connection, registrations: Registrations, prepare: Callable[[], None], processes: int) -> None:
    """Run jobs from a pipe until its other end is closed; the main function of a worker process."""
    if hasattr(os, "setsid"):
        os.setsid()  # Ctrl-C reaches only the parent, which passes it on
    stop = StopHandler()
    for number in _STOP_SIGNALS:
        signal.signal(number, stop)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOP_SIGNALS)
    pa.set_cpu_count(max(1, (os.cpu_count() or 1) // processes))
    prepare()
    registrations.register()
    with keep_destinations_open() as keep_open, suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while not stop.requested:
            _run_tasks(pipe, pipe.recv_bytes(), stop, keep_open)


def _run_tasks(pipe: Connection, pickled: bytes, stop: StopHandler, keep_open: KeepOpen) -> None:
    def send(number: int, content: Event | Report) -> None:
        stop.disable()  # an interrupt in the middle of a message would leave half of it in the pipe
        # `pipe.send` would leave a view of a BytesIO in the traceback, whose collection crashes CPython before 3.12.3.
        pipe.send_bytes(pickle.dumps((number, content)))

    def tell(number: int, event: Event) -> None:
        send(number, event)
        stop.enable()

    try:
        tasks: list[Task] = pickle.loads(pickled)  # noqa: S301 - from our own parent
    except Exception as error:  # noqa: BLE001 - unpickling runs the code of the job's classes
        pipe.send(IngestError(f"the job cannot be read in another process: {type(error).__name__}: {error}"))
        return
    finished = 0
    try:
        stop.enable()
        for report in InProcess().map(tasks, tell):
            send(finished, report)
            finished += 1
    except KeyboardInterrupt:
        error = Interrupted("stopped before the recording was opened")
        send(finished, failed_report(tasks[finished], error, partial(tell, finished)))
    stop.disable()
    pipe.send(None)
    keep_open(tasks[-1].job.destination)


def _spawn_worker(prepare: Callable[[], None], processes: int) -> _Worker:
    spawning = multiprocessing.get_context("spawn")  # forking is unsafe because this process has threads
    ours, theirs = spawning.Pipe()
    try:
        process = spawning.Process(
            target=work,
            args=(theirs, Registrations.current(), prepare, processes),
            name="ingest-worker",
            daemon=True,
        )
        with _stop_signals_blocked():
            process.start()
    except Exception as error:
        ours.close()
        raise _unsendable(error) from error
    finally:
        theirs.close()
    return _Worker(process, ours)


@contextmanager
def _stop_signals_blocked() -> Generator[None]:
    """Block signals to stop; a new process inherits the mask, so Ctrl-C cannot interrupt its imports."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, _STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _split_memory(job: Job, processes: int) -> Job:
    """Return a job with its share of the memory of `processes` simultaneous runs."""
    budget = MemoryBudget() if job.run.memory is None else MemoryBudget(job.run.memory)
    return job.replace(run=job.run.replace(memory=budget.split(processes).total_bytes))


def _signal(worker: _Worker, number: signal.Signals) -> None:
    if worker.process.pid is not None and worker.process.is_alive():
        os.kill(worker.process.pid, number)


def _unsendable(error: Exception) -> IngestError:
    return IngestError(
        f"the job cannot be sent to another process: {error}",
        hint="define its adapters at the top level of a module, or run with one job",
    )


def _worker_died(exit_code: int | None, attempts: int) -> IngestError:
    if exit_code is not None and exit_code < 0:
        cause = f"was killed by {signal.Signals(-exit_code).name}"
    else:
        cause = f"ended with exit code {exit_code}"
    killed = exit_code == -_SIGKILL
    return IngestError(
        f"the worker process {cause} in each of {attempts} attempts",
        hint="memory may have run out: use fewer jobs or a smaller run.memory" if killed else None,
    )
