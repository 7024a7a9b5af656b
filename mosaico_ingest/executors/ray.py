"""The executor that runs recordings as tasks on a Ray cluster: the driver, the task of a worker, and the shipped files."""

from __future__ import annotations

import logging
import pickle
import shutil
import signal
import socket
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from os.path import abspath, relpath
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa
from msgspec import Struct, structs

from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.destinations.store.files import translate_errors
from mosaico_ingest.errors import BagError, IngestError, Interrupted, SinkError
from mosaico_ingest.executors import Batch, Registrations
from mosaico_ingest.executors.processes import ATTEMPTS
from mosaico_ingest.interrupts import StopHandler, count_interrupts
from mosaico_ingest.job.fields import AdapterRef, FilePath, PathRole, marked_fields, replace_values, values_at
from mosaico_ingest.job.model import Job, JobSettings
from mosaico_ingest.metadata import schema_files
from mosaico_ingest.pipeline.run import failed_report, run_recording
from mosaico_ingest.pipeline.task import DEFAULT_BYTES, Task
from mosaico_ingest.remote import is_url
from mosaico_ingest.report.events import BatchObserver, Event, RunFinished, RunStarted
from mosaico_ingest.report.recording import Report
from mosaico_ingest.rosbag.definitions.registry import definition_files

try:
    import ray
    from ray import cloudpickle
    from ray import exceptions as ray_errors
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as missing:
    raise IngestError("Ray is not installed", hint="pip install 'mosaico-ingest[ray]'") from missing


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
Notice: TypeAlias = tuple[int, int, Event | logging.LogRecord]
"""The position of the recording, the number of the attempt, and an event or a log record."""
_POST_INTERVAL_S = 0.2
"""Seconds between two posts to the mailbox."""
_FILES = "files"
"""The folder of the shipment that mirrors the paths of this machine."""
_HERE = ".here"
"""The name of the empty file that keeps a folder in the shipment."""
_YAML = frozenset({".yaml", ".yml"})
_CODE = _YAML | {".py"}
_SHIPPED = {PathRole.WORKER_FILE, PathRole.DEFINITIONS, PathRole.SCHEMA}


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


def absolute(task: Task) -> Task:
    """Return a task with absolute paths."""
    job = task.job
    store = destination_of(job.destination).local_folder if job.target.type is None else None
    if store is not None:
        job = job.replace(target=job.target.replace(store=str(store)))
    for marked in marked_fields(JobSettings, FilePath):
        if marked.marker.role is not PathRole.RECORDING:
            job = replace_values(
                job, marked.path, lambda _, path: path if is_url(path) else str(_absolute(path))
            )
    return structs.replace(
        task,
        job=job.replace(
            paths=tuple(_absolute(path) if isinstance(path, Path) else path for path in job.paths),
            origin=structs.replace(job.origin, folder=_absolute(job.folder)),
        ),
    )


def pack(tasks: Iterable[Task], folder: Path) -> list[Task]:
    """Copy adapters, definitions and certificates into `folder`; return tasks that are valid in a copy of it.

    Adapters keep their names, so the plan stays the same. Adapters with an absolute path and installed packages are not
    copied and must exist on every machine.
    """
    packer = _Packer(folder)
    return [packer.add(task) for task in tasks]


class _Packer(Struct, frozen=True):
    folder: Path

    def add(self, task: Task) -> Task:
        job = task.job
        for marked in marked_fields(JobSettings, AdapterRef):
            for _, reference in values_at(job, marked.path):
                self._add_adapter(reference, job.folder)
        for marked in marked_fields(JobSettings, FilePath):
            if marked.marker.role in _SHIPPED:
                add = self._add_schema if marked.marker.role is PathRole.SCHEMA else self._add_input
                job = replace_values(job, marked.path, add)
        self._add_all([], folder=job.folder)
        return structs.replace(task, job=job, code_dir=_shipped(job.folder))

    def _add_input(self, _: object, path: str) -> str:
        """Add a file, or the message definitions of a folder; return its path in the shipment."""
        self._add_all(definition_files(Path(path)) if Path(path).is_dir() else [Path(path)])
        return str(_shipped(path))

    def _add_schema(self, _: object, path: str) -> str:
        """Add a JSON Schema with the files that it refers to; return its path in the shipment."""
        self._add_all(schema_files(Path(path)))
        return str(_shipped(path))

    def _add_adapter(self, reference: object, base_dir: Path) -> None:
        """Copy the file or module of a reference with its neighbors, which it may import."""
        if isinstance(reference, type):
            self._add_module(reference.__module__, base_dir)
        elif isinstance(reference, (str, Path)) and str(reference) not in BY_NAME:
            source, colon, _ = str(reference).rpartition(":")
            if Path(reference).suffix in _YAML:
                self._add_all(_beside(base_dir / reference, _YAML))
            elif source.endswith(".py"):
                self._add_all(_beside(base_dir / source, _CODE))
            elif colon:
                self._add_module(source, base_dir)

    def _add_module(self, name: str, base_dir: Path) -> None:
        """Copy a module with its package unless it is installed: into the import path, or below `base_dir`."""
        file = getattr(sys.modules.get(name.partition(".")[0]), "__file__", None)
        if file is None or _is_installed(Path(file)):
            return
        source = Path(file).parent if Path(file).name == "__init__.py" else Path(file)
        files = [source] if source.is_file() else _matching(source.rglob("*"), _CODE)
        if source.parent == base_dir:
            self._add_all(files)
        else:
            for code in files:
                _copy(code, self.folder / code.relative_to(source.parent))

    def _add_all(self, files: Iterable[Path], *, folder: Path | None = None) -> None:
        for file in files:
            _copy(file, self.folder / _shipped(file))
        if folder is not None:  # `../adapters` needs its folder, and shipments contain no empty folders
            marker = self.folder / _shipped(folder) / _HERE
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.touch()


def _beside(file: Path, suffixes: frozenset[str]) -> Iterator[Path]:
    """Yield the files in the folder of a file, and the files of the packages in that folder."""
    folder = _absolute(file).parent
    yield from _matching(folder.iterdir(), suffixes)
    for package in folder.glob("*/__init__.py"):
        yield from _matching(package.parent.rglob("*"), suffixes)


def _matching(paths: Iterable[Path], suffixes: frozenset[str]) -> list[Path]:
    return [path for path in paths if path.suffix in suffixes and path.is_file()]


def _shipped(path: Path | str) -> Path:
    """Return the path of a file in the shipment."""
    return Path(_FILES, *_absolute(path).parts[1:])


def _absolute(path: Path | str) -> Path:
    return Path(abspath(path))  # noqa: PTH100 - keep links, which may be the path that all machines share


def _copy(source: Path, to: Path) -> None:
    if not to.exists():
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, to)


def _is_installed(file: Path) -> bool:
    folders = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return any(file.is_relative_to(folder) for folder in folders)
