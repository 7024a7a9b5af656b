"""This file runs configurations on Ray: each recording is a task, on whichever node of a cluster has room for it."""

from __future__ import annotations

import logging
import socket
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from os.path import relpath
from pathlib import Path
from typing import Any

from msgspec import Struct

from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.destinations.store.errors import explained
from mosaico_ingest.errors import IngestError, Interrupted
from mosaico_ingest.executors.batch import Batch
from mosaico_ingest.executors.processes import ATTEMPTS, Registrations
from mosaico_ingest.executors.shipment import absolute, pack
from mosaico_ingest.interrupts import counted_interrupts
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.plan import DEFAULT_MEMORY_BYTES
from mosaico_ingest.report.events import BatchObserver, RunStarted
from mosaico_ingest.report.model import Report

try:
    import ray
    from ray import cloudpickle
    from ray import exceptions as ray_errors
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as missing:
    raise IngestError("Ray is not installed", hint="pip install 'mosaico-ingest[ray]'") from missing

from mosaico_ingest.executors.ray_worker import (
    Mailbox,
    Setting,
    ingest,
    machine,
)

__all__ = ["Ray"]

_log = logging.getLogger(__name__)

NODES = 3
"""How many nodes may go under a recording before it has failed: a node that goes is not its doing, mostly."""
_POLL_S = 0.1
_SHUTDOWN_S = 10.0
_CONNECT_S = 5.0
_AT_ONCE = 1000
"""How many tasks Ray is given at a time, so that it sees how many nodes there is work for."""
_WORKER_BYTES = 256 << 20
"""What a worker takes beside the batches."""
_HERE: dict[str, Any] = {"include_dashboard": False, "object_store_memory": 128 << 20}
"""How Ray is started on this machine: only configurations and reports travel."""
_PACKAGE = str(Path(__file__).parents[1])
_NODE_ERRORS = (ray_errors.NodeDiedError, ray_errors.ObjectLostError)


class Ray(Struct, frozen=True):
    """The executor for a cluster: connects to the one at `address`, or starts Ray on this machine.

    A worker that dies takes only its recording with it, which is begun anew up to `attempts` times; one whose node went
    is begun on another. At most `jobs` recordings are in work, without it as many as there is room for.
    A program that is connected to Ray already keeps its connection, and its runtime environment.
    """

    address: str | None = None
    jobs: int | None = None
    attempts: int = ATTEMPTS

    def map(self, configs: Sequence[ROSInjectionConfig], observe: BatchObserver) -> Iterator[Report]:
        """Yield the report of each configuration; see `Executor.map`.

        Raises:
            IngestError: There is no Ray at the address, or it ends under the run.
        """
        if not configs:
            return
        batch = Batch(configs, observe)
        with ExitStack() as stack:
            sent = [absolute(config) for config in configs]
            if not ray.is_initialized():
                sent = stack.enter_context(_connected(self.address, self.jobs, sent))
            beacon = stack.enter_context(_beacon(sent, batch.run))
            run = _Run(batch, sent, self.jobs or _AT_ONCE, self.attempts, _start_mailbox(), _setting(beacon))
            stack.callback(run.shut_down)
            interrupts = stack.enter_context(counted_interrupts())
            try:
                yield from run.reports(interrupts)
            except ray_errors.RayError as error:
                raise IngestError(f"Ray ended under the run: {_said(error)}") from error


@dataclass(slots=True)
class _Run:
    batch: Batch
    sent: Sequence[ROSInjectionConfig]
    at_once: int
    attempts: int
    mailbox: Any
    setting: Any
    tasks: dict[Any, int] = field(default_factory=dict[Any, int])
    """The recording each of Ray's references stands for."""
    started: set[int] = field(default_factory=set[int])
    nodes_lost: Counter[int] = field(default_factory=Counter[int])
    interrupted: int = 0

    def reports(self, interrupts: list[int]) -> Iterator[Report]:
        """Yield reports in order, as soon as those before them are there too."""
        largest_bytes = max((node["Resources"].get("memory", 0) for node in ray.nodes()), default=0)
        while self.batch.waiting or self.tasks:
            while self.batch.waiting and len(self.tasks) < self.at_once:
                self._begin(self.batch.waiting.popleft(), int(largest_bytes))
            done, _ = ray.wait(list(self.tasks), timeout=_POLL_S) if self.tasks else ([], [])
            self._receive()  # whatever a task had to say came in before it was done
            for task in done:
                self._take(task, self.tasks.pop(task))
            if len(interrupts) > self.interrupted:
                self._interrupt()
            yield from self.batch.reports()
        yield from self.batch.rest()

    def shut_down(self) -> None:
        """End what is still in work."""
        with suppress(ray_errors.RayError):
            for force in (False, True):
                self._cancel(force=force)
                if self.tasks:
                    done, _ = ray.wait(list(self.tasks), num_returns=len(self.tasks), timeout=_SHUTDOWN_S)
                    self.tasks = {task: position for task, position in self.tasks.items() if task not in done}
            ray.kill(self.mailbox)

    def _begin(self, position: int, largest_bytes: int) -> None:
        attempt = self.batch.begin(position)
        config = replace(self.sent[position], attempt=attempt)
        try:
            pickled = cloudpickle.dumps(config)  # pyright: ignore[reportPrivateImportUsage] - its module re-exports it
        except Exception as error:  # noqa: BLE001 - pickle raises what the object's class raises
            self.batch.fail(position, IngestError(f"the job cannot be sent to another machine: {error}"))
            return
        wanted_bytes = (config.memory_bytes or DEFAULT_MEMORY_BYTES) + _WORKER_BYTES
        # Ray's own retries count no node that goes and no memory that runs out, so a recording could cost them all.
        task = ray.remote(ingest).options(
            name=f"ingest {config.sequence_name}",
            num_cpus=1,
            memory=min(wanted_bytes, largest_bytes),
            max_retries=0,
            scheduling_strategy="SPREAD",
        )
        self.tasks[task.remote(pickled, position, attempt.number, self.mailbox, self.setting)] = position

    def _receive(self) -> None:
        for position, attempt, said in ray.get(self.mailbox.fetch.remote()):
            if isinstance(said, logging.LogRecord):
                logging.getLogger(said.name).handle(said)
            elif attempt == self.batch.begun[position]:
                self.started.add(position)
                self.batch.tell(position, self._as_given(position, said))

    def _take(self, task: Any, position: int) -> None:  # noqa: ANN401 - Ray's reference
        said: Any
        try:
            said = ray.get(task)
        except ray_errors.RuntimeEnvSetupError as error:
            self.batch.fail(position, IngestError(f"Ray could not send the job's files: {_said(error)}"))
        except ray_errors.RayError as error:
            self._task_died(position, error)
        else:
            if isinstance(said, Report):
                self.batch.finish(position, self._as_given(position, said))
            else:
                self.batch.fail(position, said)

    def _task_died(self, position: int, error: ray_errors.RayError) -> None:
        """Account for a task that came to nothing: its recording is begun anew, or has failed."""
        if self.interrupted:
            if position in self.started:
                self.batch.fail(position, Interrupted("stopped before the end of the recording"))
            return
        self.nodes_lost[position] += isinstance(error, _NODE_ERRORS)
        deaths = self.batch.begun[position] - self.nodes_lost[position]
        if deaths < self.attempts and self.nodes_lost[position] < NODES:
            _log.warning("%s is begun anew: %s", self.batch.configs[position].sequence_name, _said(error))
            self.batch.again(position)
        else:
            self.batch.fail(position, _died(error, self.batch.begun[position]))

    def _interrupt(self) -> None:
        """Begin nothing more and let what is in work end as its policy says; asked twice, end it at once."""
        self.batch.waiting.clear()
        self._cancel(force=self.interrupted > 0)
        self.interrupted += 1

    def _cancel(self, *, force: bool) -> None:
        for task in self.tasks:
            ray.cancel(task, force=force, recursive=False)

    def _as_given(self, position: int, said: Any) -> Any:  # noqa: ANN401 - an event or a report, as it came
        """Spell places as the job does: on another machine they had to be absolute."""
        if not isinstance(said, RunStarted | Report):
            return said
        given = self.batch.configs[position]
        files, destination = said.files, destination_of(given.target).describe()
        if all(isinstance(path, Path) and not path.is_absolute() for path in given.paths):
            files = tuple(map(relpath, files))
        if isinstance(said, Report):
            return said.model_copy(update={"files": files, "destination": destination})
        return replace(said, files=files, destination=destination)


def _died(error: ray_errors.RayError, attempts: int) -> IngestError:
    if isinstance(error, _NODE_ERRORS):
        return IngestError(f"the node that ingested it went away, {NODES} times in all")
    memory = isinstance(error, ray_errors.OutOfMemoryError)
    return IngestError(
        f"the worker that ingested it {'ran out of memory' if memory else 'died'}, {attempts} times in all",
        hint="give less run.memory" if memory else f"Ray says: {_said(error)}",
    )


@contextmanager
def _connected(
    address: str | None, jobs: int | None, configs: list[ROSInjectionConfig]
) -> Generator[list[ROSInjectionConfig]]:
    """Connect to Ray; yield the configurations as its workers will understand them."""
    if address is not None and address.startswith("ray://"):
        raise IngestError(
            f"{address} is the address of Ray's client server",
            hint="run on a machine of the cluster, with --address auto, or by `ray job submit`",
        )
    _check_reachable(address)
    with tempfile.TemporaryDirectory(prefix="mosaico-ingest-") as folder:
        sent = configs
        options: dict[str, Any] = {**_HERE, "num_cpus": jobs}
        if address is not None:
            sent = pack(configs, Path(folder))
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
    """Find out whether anybody is at `host:port`: Ray would try for minutes."""
    host, _, port = (address or "").rpartition(":")
    if port.isdecimal():
        try:
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        except OSError as error:
            raise _unreachable(address, error) from error


def _unreachable(address: str | None, error: Exception) -> IngestError:
    return IngestError(
        f"cannot connect to Ray: {_said(error)}",
        where=address,
        hint="`ray status --address` says more; a cluster may want a token (RAY_AUTH_MODE, RAY_AUTH_TOKEN)",
    )


@contextmanager
def _beacon(configs: Sequence[ROSInjectionConfig], run: str) -> Generator[str]:
    """Put a file into every store while the run goes on, so that no worker takes another folder for it."""
    name = f".run-{run}"
    stores = {destination_of(config.target).local_folder for config in configs}
    folders = [path for path in stores if path is not None]
    for folder in folders:
        with explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / name).touch()
    try:
        yield name
    finally:
        for folder in folders:
            with suppress(OSError):
                (folder / name).unlink()
                folder.rmdir()  # where nothing came of it


def _start_mailbox() -> Any:  # noqa: ANN401 - Ray's handle
    """Start the mailbox on the driver's own node, whose end would be the run's end anyway."""
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    return ray.remote(Mailbox).options(num_cpus=0, scheduling_strategy=here).remote()


def _setting(beacon: str) -> Any:  # noqa: ANN401 - Ray's reference
    level = logging.getLogger().getEffectiveLevel()
    return ray.put(Setting(Registrations.current(), level, beacon, machine()))


def _said(error: Exception) -> str:
    """Return the first line of an error of Ray's, which may have a page of advice."""
    return str(error).strip().partition("\n")[0] or type(error).__name__
