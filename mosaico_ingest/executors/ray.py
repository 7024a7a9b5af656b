"""The executor that runs recordings as tasks on a Ray cluster."""

from __future__ import annotations

import logging
import socket
import tempfile
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from os.path import relpath
from pathlib import Path
from typing import Any

from msgspec import Struct, structs

from mosaico_ingest.destinations.base import destination_of
from mosaico_ingest.destinations.store.files import translate_errors
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors.batch import Batch, Registrations
from mosaico_ingest.executors.processes import ATTEMPTS
from mosaico_ingest.executors.shipment import absolute, pack
from mosaico_ingest.interrupts import count_interrupts
from mosaico_ingest.pipeline.memory import DEFAULT_BYTES
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import BatchObserver, RunStarted
from mosaico_ingest.report.model import Report

try:
    import ray
    from ray import cloudpickle
    from ray import exceptions as ray_errors
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as missing:
    raise IngestError("Ray is not installed", hint="pip install 'mosaico-ingest[ray]'") from missing

from mosaico_ingest.executors.ray_worker import Mailbox, Setting, ingest, machine

_log = logging.getLogger(__name__)

MAX_NODE_FAILURES = 3
"""Number of failed nodes after which a recording fails; separate from the attempts, as a lost node is rarely its fault."""
_POLL_S = 0.1
_SHUTDOWN_S = 10.0
_CONNECT_S = 5.0
_MAX_TASKS = 1000
"""Number of tasks that Ray receives at a time; its autoscaler sizes the cluster by them."""
_WORKER_BYTES = 256 << 20
"""Bytes that a worker needs in addition to the memory budget of its recording."""
_LOCAL_OPTIONS: dict[str, Any] = {"include_dashboard": False, "object_store_memory": 128 << 20}
"""Options for starting Ray on this machine; its object store holds only jobs and reports."""
_PACKAGE = str(Path(__file__).parents[1])
_NODE_ERRORS = (ray_errors.NodeDiedError, ray_errors.ObjectLostError)


class Ray(Struct, frozen=True):
    """The executor for a Ray cluster: connects to the cluster at `address`, or starts Ray on this machine.

    If a worker dies, its recording is started again, up to `attempts` times in total; if a node is lost, on another node.
    At most `simultaneous` recordings run at the same time, by default as many as the cluster has capacity for. A program
    that is already connected to Ray keeps its connection and runtime environment.
    """

    address: str | None = None
    simultaneous: int | None = None
    attempts: int = ATTEMPTS

    def map(self, tasks: Iterable[Task], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each task; see `Executor.map`. All tasks are sent to the cluster before the first one starts.

        Raises:
            IngestError: There is no Ray cluster at the address, or it ends during the run.
        """
        tasks = list(tasks)
        if not tasks:
            return
        batch = Batch(iter(tasks), observe)
        with ExitStack() as stack:
            sent = [absolute(task) for task in tasks]
            if not ray.is_initialized():
                sent = stack.enter_context(_connected(self.address, self.simultaneous, sent))
            beacon = stack.enter_context(_beacon(sent, batch.run))
            run = _Run(
                batch,
                sent,
                self.simultaneous or _MAX_TASKS,
                self.attempts,
                _start_mailbox(),
                _setting(beacon),
            )
            stack.callback(run.shut_down)
            interrupts = stack.enter_context(count_interrupts())
            try:
                yield from run.reports(interrupts)
            except ray_errors.RayError as error:
                raise IngestError(f"Ray ended during the run: {_first_line(error)}") from error


@dataclass(slots=True)
class _Run:
    batch: Batch
    sent: Sequence[Task]
    max_tasks: int
    attempts: int
    mailbox: Any
    setting: Any
    tasks: dict[Any, int] = field(default_factory=dict[Any, int])
    """The position of the recording that each of Ray's references runs."""
    started: set[int] = field(default_factory=set[int])
    nodes_lost: Counter[int] = field(default_factory=Counter[int])
    interrupted: int = 0

    def reports(self, interrupts: list[int]) -> Iterator[Report]:
        """Yield reports in order, each as soon as the ones before it are finished."""
        largest_bytes = max((node["Resources"].get("memory", 0) for node in ray.nodes()), default=0)
        while self.batch.is_waiting or self.tasks:
            while len(self.tasks) < self.max_tasks and (position := self.batch.take()) is not None:
                self._start(position, int(largest_bytes))
            done, _ = ray.wait(list(self.tasks), timeout=_POLL_S) if self.tasks else ([], [])
            self._receive()  # a task posts its events before it ends
            for task in done:
                self._finish(task, self.tasks.pop(task))
            if len(interrupts) > self.interrupted:
                self._interrupt()
            yield from self.batch.reports()
        yield from self.batch.remaining_reports()

    def shut_down(self) -> None:
        """End the running tasks and the mailbox."""
        with suppress(ray_errors.RayError):
            for force in (False, True):
                self._cancel(force=force)
                if self.tasks:
                    done, _ = ray.wait(list(self.tasks), num_returns=len(self.tasks), timeout=_SHUTDOWN_S)
                    self.tasks = {task: position for task, position in self.tasks.items() if task not in done}
            ray.kill(self.mailbox)

    def _start(self, position: int, largest_bytes: int) -> None:
        attempt = self.batch.start(position)
        sent = structs.replace(self.sent[position], attempt=attempt)
        try:
            pickled = cloudpickle.dumps(sent)  # pyright: ignore[reportPrivateImportUsage] - its module re-exports it
        except Exception as error:  # noqa: BLE001 - pickling runs the code of the job's classes
            self.batch.fail(position, IngestError(f"the job cannot be sent to another machine: {error}"))
            return
        needed_bytes = (sent.job.run.memory or DEFAULT_BYTES) + _WORKER_BYTES
        # Ray's built-in retries do not count lost nodes or out-of-memory failures, so one recording could take down
        # every node.
        task = ray.remote(ingest).options(
            name=f"ingest {sent.job.sequence.name}",
            num_cpus=1,
            memory=min(needed_bytes, largest_bytes),
            max_retries=0,
            scheduling_strategy="SPREAD",
        )
        self.tasks[task.remote(pickled, position, attempt.number, self.mailbox, self.setting)] = position

    def _receive(self) -> None:
        for position, attempt, message in ray.get(self.mailbox.fetch.remote()):
            if isinstance(message, logging.LogRecord):
                logging.getLogger(message.name).handle(message)
            elif attempt == self.batch.attempts.get(position):
                self.started.add(position)
                self.batch.tell(position, self._with_job_paths(position, message))

    def _finish(self, task: Any, position: int) -> None:  # noqa: ANN401 - Ray's reference
        message: Any
        try:
            message = ray.get(task)
        except ray_errors.RuntimeEnvSetupError as error:
            self.batch.fail(
                position, IngestError(f"Ray could not send the job's files: {_first_line(error)}")
            )
        except ray_errors.RayError as error:
            self._task_died(position, error)
        else:
            if isinstance(message, Report):
                self.batch.finish(position, self._with_job_paths(position, message))
            else:
                self.batch.fail(position, message)

    def _task_died(self, position: int, error: ray_errors.RayError) -> None:
        """Start the recording of a task that died again, or report it as failed."""
        if self.interrupted:
            if position in self.started:
                self.batch.fail(position, Interrupted("stopped before the end of the recording"))
            return
        self.nodes_lost[position] += isinstance(error, _NODE_ERRORS)
        deaths = self.batch.attempts[position] - self.nodes_lost[position]
        if deaths < self.attempts and self.nodes_lost[position] < MAX_NODE_FAILURES:
            _log.warning(
                "%s is started again: %s", self.batch.tasks[position].job.sequence.name, _first_line(error)
            )
            self.batch.retry([position])
        else:
            self.batch.fail(position, _died(error, self.batch.attempts[position]))

    def _interrupt(self) -> None:
        """Start no more recordings and cancel the running ones; a second interrupt kills them."""
        self.batch.stop()
        self._cancel(force=self.interrupted > 0)
        self.interrupted += 1

    def _cancel(self, *, force: bool) -> None:
        for task in self.tasks:
            ray.cancel(task, force=force, recursive=False)

    def _with_job_paths(self, position: int, message: Any) -> Any:  # noqa: ANN401 - an event or a report
        """Return an event or a report with paths as in the job; a worker uses absolute ones."""
        if not isinstance(message, RunStarted | Report):
            return message
        job = self.batch.tasks[position].job
        files, destination = message.files, destination_of(job.destination).describe()
        if all(isinstance(path, Path) and not path.is_absolute() for path in job.paths):
            files = tuple(map(relpath, files))
        if isinstance(message, Report):
            return message.model_copy(update={"files": files, "destination": destination})
        return structs.replace(message, files=files, destination=destination)


def _died(error: ray_errors.RayError, attempts: int) -> IngestError:
    if isinstance(error, _NODE_ERRORS):
        return IngestError(f"the node of the worker was lost {MAX_NODE_FAILURES} times")
    memory = isinstance(error, ray_errors.OutOfMemoryError)
    return IngestError(
        f"the worker {'ran out of memory' if memory else 'died'} in each of {attempts} attempts",
        hint="use a smaller run.memory" if memory else f"Ray reports: {_first_line(error)}",
    )


@contextmanager
def _connected(address: str | None, simultaneous: int | None, tasks: list[Task]) -> Generator[list[Task]]:
    """Connect to Ray; yield the tasks with paths that are valid on its workers."""
    if address is not None and address.startswith("ray://"):
        raise IngestError(
            f"{address} is the address of Ray's client server",
            hint="run on a machine of the cluster, with --address auto, or by `ray job submit`",
        )
    _check_reachable(address)
    with tempfile.TemporaryDirectory(prefix="mosaico-ingest-") as folder:
        sent = tasks
        options: dict[str, Any] = {**_LOCAL_OPTIONS, "num_cpus": simultaneous}
        if address is not None:
            sent = pack(tasks, Path(folder))
            options = {"runtime_env": {"working_dir": folder, "py_modules": [_PACKAGE]}}
        try:
            ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, **options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise _unreachable(address, error) from error
        try:
            yield sent
        finally:
            ray.shutdown()


def _check_reachable(address: str | None) -> None:
    """Raise if nothing listens at `host:port`; Ray would retry for minutes."""
    host, _, port = (address or "").rpartition(":")
    if port.isdecimal():
        try:
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        except OSError as error:
            raise _unreachable(address, error) from error


def _unreachable(address: str | None, error: Exception) -> IngestError:
    return IngestError(
        f"cannot connect to Ray: {_first_line(error)}",
        where=address,
        hint="check it with `ray status --address`; a cluster may require a token (RAY_AUTH_MODE, RAY_AUTH_TOKEN)",
    )


@contextmanager
def _beacon(tasks: Sequence[Task], run: str) -> Generator[str]:
    """Keep a file in every store during the run, by which workers recognize the store."""
    name = f".run-{run}"
    stores = {destination_of(task.job.destination).local_folder for task in tasks}
    folders = [path for path in stores if path is not None]
    for folder in folders:
        with translate_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
    try:
        yield name
    finally:
        for folder in folders:
            with suppress(OSError):
                (folder / name).unlink()
                folder.rmdir()  # if the run wrote nothing


def _start_mailbox() -> Any:  # noqa: ANN401 - Ray's handle
    """Start the mailbox on the driver's node: if that node is lost, the run ends anyway."""
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    return ray.remote(Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()


def _setting(beacon: str) -> Any:  # noqa: ANN401 - Ray's reference
    level = logging.getLogger().getEffectiveLevel()
    return ray.put(Setting(Registrations.current(), level, beacon, machine()))


def _first_line(error: Exception) -> str:
    """Return the first line of a Ray error, which may be a page long."""
    return str(error).strip().partition("\n")[0] or type(error).__name__
