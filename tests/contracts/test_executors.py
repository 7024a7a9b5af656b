"""The common behavior of all executors: order of reports, failures, and registered types and adapters."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import pytest

from mosaico_ingest.adapters.python import ROSAdapterBase
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.destination import StoreDestination
from mosaico_ingest.destinations.store.session import StoreSession
from mosaico_ingest.executors import Executor, InProcess, do_nothing
from mosaico_ingest.executors.processes import Processes, _spawn_worker
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.ontology import IMU, Vector3d
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import (
    Event,
    RunFinished,
    RunStarted,
    RunStatus,
    TopicProgress,
    ignore_batch,
)
from mosaico_ingest.report.recording import Report
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"

_STILL = Vector3d(x=0.0, y=0.0, z=0.0)


class Killer(ROSAdapterBase[IMU]):
    """An adapter whose process dies of it; only the first time where the job's folder remembers."""

    ros_msgtype = "sensor_msgs/msg/Imu"
    __mosaico_ontology_type__ = IMU

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:
        os.kill(os.getpid(), signal.SIGKILL)
        raise NotImplementedError(ros_data)


class KillerOnce(Killer):
    """The same, until a file says that it has happened."""

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:  # noqa: ARG003 - the base class's signature
        happened = Path(os.environ["KILLED_ONCE"]) / "once"
        if not happened.exists():
            happened.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return IMU(acceleration=_STILL, angular_velocity=_STILL)


class KillerAfterCommit(Killer):
    """One whose process dies once, when the sequence is in the store and nobody has been told."""

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:  # noqa: ARG003 - the base class's signature
        StoreDestination.commit = _commit_and_die_once  # type: ignore[method-assign] - only in the worker's process
        return IMU(acceleration=_STILL, angular_velocity=_STILL)


_COMMIT = StoreDestination.commit


def _commit_and_die_once(
    destination: StoreDestination, sessions: Sequence[StoreSession]
) -> list[Exception | None]:
    errors = _COMMIT(destination, sessions)
    happened = [Path(os.environ["KILLED_ONCE"]) / session.closed.claim.sequence for session in sessions]
    if not all(path.exists() for path in happened):
        for path in happened:
            path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return errors


class Refusing(ROSAdapterBase[IMU]):
    """An adapter that no message fits."""

    ros_msgtype = "sensor_msgs/msg/Imu"
    __mosaico_ontology_type__ = IMU

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:
        raise ValueError(min(ros_data))


class Slow(Refusing):
    """One that gives time to interrupt it."""

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:
        time.sleep(0.02)
        return super().from_dict(ros_data)


class SlowJoints(ROSAdapterBase[IMU]):
    """An adapter that rejects every message, slowly."""

    ros_msgtype = "sensor_msgs/msg/JointState"
    __mosaico_ontology_type__ = IMU

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> IMU:
        time.sleep(0.002)
        raise ValueError(min(ros_data))


def tasks(folder: Path, names: Iterable[str], **more: Any) -> list[Task]:
    options: dict[str, Any] = {"store": folder / "store", "topics": ["/imu"], **more}
    return [Task(ROSInjectionConfig(DRIVE, name, **options).job) for name in names]


@pytest.fixture(scope="module")
def killed_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder killers remember by; a cluster's workers have the environment that it was started with."""
    with pytest.MonkeyPatch.context() as patch:
        happened = tmp_path_factory.mktemp("killed")
        patch.setenv("KILLED_ONCE", str(happened))
        yield happened


@pytest.fixture(scope="module")
def on_ray(killed_once: Path) -> Iterator[Executor]:  # noqa: ARG001 - to be set before it starts
    """An executor in a program that is connected to a cluster of two nodes."""
    from ray_cluster import connected, two_nodes  # noqa: PLC0415 - it imports Ray, where that is installed

    with two_nodes() as cluster, connected(cluster.address):
        from mosaico_ingest.executors.ray import Ray  # noqa: PLC0415 - it imports Ray, where that is installed

        yield Ray()


RAY = pytest.param("ray", marks=pytest.mark.slow)


def _executor(request: pytest.FixtureRequest) -> Executor:
    if request.param == "ray":
        pytest.importorskip("ray", reason="Ray is not installed")
        return request.getfixturevalue("on_ray")
    return InProcess() if request.param == "in_process" else Processes(2)


@pytest.fixture(params=["in_process", "processes", RAY])
def executor(request: pytest.FixtureRequest) -> Executor:
    return _executor(request)


@pytest.fixture(params=["processes", RAY])
def elsewhere(request: pytest.FixtureRequest, killed_once: Path) -> Executor:
    """An executor whose workers may die."""
    shutil.rmtree(killed_once)
    killed_once.mkdir()
    return _executor(request)


def test_executor_returns_reports_in_order_and_stores_sequences(executor: Executor, tmp_path: Path) -> None:
    reports = list(executor.map(tasks(tmp_path, "abcde"), ignore_batch))
    assert [report.sequence for report in reports] == list("abcde")
    assert {report.status for report in reports} == {RunStatus.COMPLETED}
    assert {report.totals.written for report in reports} == {1000}
    assert Store.open(tmp_path / "store").names() == tuple("abcde")


def test_executor_failed_recording_does_not_stop_others(executor: Executor, tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no recording")
    jobs = tasks(tmp_path, "abc")
    jobs[1] = Task(ROSInjectionConfig(broken, "b", store=tmp_path / "store").job)
    reports = list(executor.map(jobs, ignore_batch))
    assert [report.exit_code for report in reports] == [0, 1, 0]
    assert "broken.mcap" in (reports[1].error or "")
    assert Store.open(tmp_path / "store").names() == ("a", "c")


def test_executor_events_state_their_recording(executor: Executor, tmp_path: Path) -> None:
    caught: list[tuple[int, Event]] = []
    list(executor.map(tasks(tmp_path, "abc"), lambda position, event: caught.append((position, event))))
    for position, name in enumerate("abc"):
        events = [event for at, event in caught if at == position]
        assert isinstance(events[0], RunStarted)
        assert events[0].sequence == name
        assert isinstance(events[-1], RunFinished)
        assert sum(event.written for event in events if isinstance(event, TopicProgress)) == 1000


def test_executor_sends_adapter_classes_to_workers(executor: Executor, tmp_path: Path) -> None:
    jobs = tasks(tmp_path, "ab", adapter_override={"/imu": Refusing}, topics_on_error="raise")
    reports = list(executor.map(jobs, ignore_batch))
    assert [report.exit_code for report in reports] == [1, 1]


def test_executor_sends_registered_types_to_workers(executor: Executor, tmp_path: Path) -> None:
    bare = tmp_path / "drive.mcap"
    shutil.copy(DRIVE, bare)
    before = ROSTypeRegistry.snapshot()
    ROSTypeRegistry.register("acme_msgs/msg/OnlyHere", "uint8 x")
    try:
        reports = list(executor.map(tasks(tmp_path, "ab"), ignore_batch))
    finally:
        ROSTypeRegistry.restore(before)
    assert [report.exit_code for report in reports] == [0, 0]


def test_executor_without_configurations_returns_no_reports(executor: Executor) -> None:
    assert list(executor.map([], ignore_batch)) == []


def test_executor_dead_worker_fails_only_its_recording(elsewhere: Executor, tmp_path: Path) -> None:
    jobs = tasks(tmp_path, "abc")
    jobs[1] = tasks(tmp_path, "b", adapter_override={"/imu": Killer})[0]
    reports = list(elsewhere.map(jobs, ignore_batch))
    assert [report.exit_code for report in reports] == [0, 1, 0]
    assert "2 attempts" in (reports[1].error or "")
    assert Store.open(tmp_path / "store").names() == ("a", "c")


def test_executor_dead_worker_fails_only_its_recording_of_a_group(tmp_path: Path) -> None:
    jobs = tasks(tmp_path, "abcdefgh")
    jobs[6] = tasks(tmp_path, "g", adapter_override={"/imu": Killer})[0]
    reports = list(Processes(2).map(jobs, ignore_batch))
    assert [report.exit_code for report in reports] == [0, 0, 0, 0, 0, 0, 1, 0]
    assert [report.totals.written for report in reports] == [1000, 1000, 1000, 1000, 1000, 1000, 0, 1000]
    assert Store.open(tmp_path / "store").names() == tuple("abcdefh")


def test_executor_killed_worker_hints_at_memory(tmp_path: Path) -> None:
    jobs = [*tasks(tmp_path, "a", adapter_override={"/imu": Killer}), *tasks(tmp_path, "b")]
    reports = list(Processes(2).map(jobs, ignore_batch))
    assert "SIGKILL" in (reports[0].error or "")
    assert "fewer jobs" in (reports[0].error or "")


def test_executor_retries_the_recording_of_a_dead_worker(
    elsewhere: Executor, killed_once: Path, tmp_path: Path
) -> None:
    jobs = tasks(tmp_path, "ab", adapter_override={"/imu": KillerOnce})
    reports = list(elsewhere.map(jobs, ignore_batch))
    assert [path.name for path in killed_once.iterdir()] == ["once"]
    assert [(report.status, report.totals.written) for report in reports] == [(RunStatus.COMPLETED, 1000)] * 2


@pytest.mark.slow
def test_executor_retry_after_commit_stores_the_sequence_once(
    elsewhere: Executor, killed_once: Path, tmp_path: Path
) -> None:
    policies = ["append", "fail", "replace", "skip"]
    list(InProcess().map(tasks(tmp_path, ["append"]), ignore_batch))
    jobs = [
        tasks(
            tmp_path,
            [policy],
            adapter_override={"/imu": KillerAfterCommit},
            manifest={"sequence": {"if_exists": policy}},
        )[0]
        for policy in policies
    ]
    reports = list(elsewhere.map(jobs, ignore_batch))
    assert sorted(path.name for path in killed_once.iterdir()) == policies
    assert [(report.status, report.totals.written) for report in reports] == [(RunStatus.COMPLETED, 1000)] * 4
    sequences = Store.open(tmp_path / "store").sequences()
    assert [sequence.rows for sequence in sequences] == [2000, 1000, 1000, 1000]


def test_executor_unpicklable_configuration_fails_with_a_hint(tmp_path: Path) -> None:
    class Local(Refusing):
        pass

    jobs = tasks(tmp_path, "abcdefgh")
    jobs[5] = tasks(tmp_path, "f", adapter_override={"/imu": Local})[0]
    reports = list(Processes(2).map(jobs, ignore_batch))
    assert [report.exit_code for report in reports] == [0, 0, 0, 0, 0, 1, 0, 0]
    assert "top level of a module" in (reports[5].error or "")


def test_executor_interrupt_applies_the_session_policy_in_every_process(tmp_path: Path) -> None:
    jobs = tasks(tmp_path, "abcdef", adapter_override={"/imu": Slow}, topics_on_error="ignore")
    before = signal.getsignal(signal.SIGINT)
    begun: set[int] = set()

    def interrupt_once_both_run(position: int, event: Event) -> None:
        if isinstance(event, RunStarted):
            begun.add(position)
            if len(begun) == 2:
                threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()

    reports: list[Report] = list(Processes(2).map(jobs, interrupt_once_both_run))
    assert [(report.sequence, report.status) for report in reports] == [
        ("a", RunStatus.INTERRUPTED),
        ("b", RunStatus.INTERRUPTED),
    ]
    assert {report.exit_code for report in reports} == {130}
    assert Store.open(tmp_path / "store").names() == ()
    assert signal.getsignal(signal.SIGINT) is before


def test_executor_divides_memory_among_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int | None] = []
    jobs = tasks(tmp_path, "abcd", manifest={"run": {"memory": 400 << 20}})
    monkeypatch.setattr(
        "mosaico_ingest.executors.processes._Pool.reports",
        lambda self, _: iter(seen.extend(job.job.run.memory for job in self.batch.source) or ()),
    )
    assert list(Processes(4).map(jobs, ignore_batch)) == []
    assert seen == [100 << 20] * 4


def test_worker_that_loses_its_parent_discards_its_session(tmp_path: Path) -> None:
    (job,) = tasks(
        tmp_path,
        "a",
        topics=["/imu", "/joint_states"],
        adapter_override={"/joint_states": SlowJoints},
        topics_on_error="ignore",
    )
    worker = _spawn_worker(do_nothing, 1)
    worker.pipe.send_bytes(ForkingPickler.dumps([job]))
    while True:
        _number, event = worker.pipe.recv()
        if isinstance(event, TopicProgress) and event.written:
            break
    worker.pipe.close()
    worker.process.join(30)
    assert worker.process.exitcode == 0
    assert Store.open(tmp_path / "store").names() == ()
