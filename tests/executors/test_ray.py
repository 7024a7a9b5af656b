"""A cluster of two nodes: same results as one machine, lost nodes, interrupts and shipped files."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from mosaico_ingest.api import compile_job
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.model import DestinationSettings
from mosaico_ingest.report.events import Event, RunStarted
from mosaico_ingest.report.run import RunReport

pytest.importorskip("ray", reason="Ray is not installed")

from ray_cluster import two_nodes

from mosaico_ingest.executors.processes import Registrations
from mosaico_ingest.executors.ray import Ray, Setting, machine, out_of_reach
from mosaico_ingest.pipeline.task import Task

pytestmark = pytest.mark.slow

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"
ADAPTER = """
import logging
import time
from pathlib import Path

from imu_factor import FACTOR

from mosaico_ingest.adapters import ROSAdapterBase
from mosaico_ingest.ontology import IMU, Vector3d


class Slow(ROSAdapterBase[IMU]):
    ros_msgtype = "sensor_msgs/msg/Imu"
    __mosaico_ontology_type__ = IMU
    said = False

    @classmethod
    def from_dict(cls, ros_data):
        while not Path(WAIT).exists():
            time.sleep(0.01)
        if not cls.said:
            logging.getLogger("slow").warning("at work")
            cls.said = True
        return IMU(acceleration=Vector3d(x=FACTOR, y=0.0, z=0.0), angular_velocity=Vector3d(x=0.0, y=0.0, z=0.0))
"""
CONTRACT = """
expect:
  on_failure: warn
  group: {starts: {within: 1 s}}
  topics: {/imu: {rate: {min: 150 Hz}, fields: {acceleration.x: {equals: 2.0}}}}
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with two_nodes() as both:
        yield both


def make_job(folder: Path, names: str, *, wait_for: str = "") -> Path:
    """A job with an adapter file that imports another file and waits until a marker file exists."""
    (folder / "adapters").mkdir(parents=True)
    for name in names:
        shutil.copy(DRIVE, folder / f"{name}.mcap")
    (folder / "adapters" / "imu.py").write_text(ADAPTER.replace("WAIT", repr(str(folder / wait_for))))
    (folder / "adapters" / "imu_factor.py").write_text("FACTOR = 2.0\n")
    manifest = folder / "job.yaml"
    manifest.write_text(
        'bag: {path: "*.mcap"}\ntopics: [/imu]\ntarget: {store: store}\n'
        'adapters: {override: {/imu: "adapters/imu.py:Slow"}}\n'
    )
    return manifest


def ingest(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mosaico_ingest", "run", "job.yaml", "--report", "run.json", *arguments]
    return subprocess.Popen(  # noqa: S603 - our own command
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    try:
        _, output = process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, output


def outcome(folder: Path) -> list[dict[str, Any]]:
    """Return a run's report without its durations."""
    report = RunReport.model_validate_json((folder / "run.json").read_text())
    timed = {"started_at", "duration_s", "steps"}
    return [recording.model_dump(mode="json", exclude=timed) for recording in report.recordings]


def test_ray_cluster_gives_the_same_result_as_one_machine(cluster: Any, tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        with make_job(folder, "abcd").open("a") as manifest:
            manifest.write(CONTRACT)
    code, output = ended(ingest(here))
    assert code == 0, output
    code, output = ended(
        ingest(there, "--executor", "ray", "--address", cluster.address, "--log-format", "json")
    )
    assert code == 0, output
    assert outcome(there) == outcome(here)
    results = [one["outcome"] for one in outcome(there)[0]["contract"]["results"]]
    assert results == ["passed", "failed", "passed"]
    ours, theirs = Store.open(here / "store"), Store.open(there / "store")
    assert theirs.names() == ours.names() == tuple("abcd")
    for name in ours.names():
        assert theirs.scan(name, "/imu").read_all() == ours.scan(name, "/imu").read_all()
    lines = [json.loads(line) for line in output.splitlines()]
    assert sorted(line["sequence"] for line in lines if line["event"] == "finished") == list("abcd")
    assert {line["message"] for line in lines if line["event"] == "log"} == {"at work"}
    assert not list((there / "store").glob(".run-*"))


def test_run_interrupted_follows_session_policy_and_exits_130(cluster: Any, tmp_path: Path) -> None:
    make_job(tmp_path, "abcd", wait_for="never")
    process = ingest(tmp_path, "--executor", "ray", "--address", cluster.address, "--log-format", "json")
    assert process.stderr is not None
    started = 0
    for line in process.stderr:
        started += json.loads(line)["event"] == "started"
        if started == 2:
            break
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)
    code, output = ended(process)
    assert code == 130, output
    assert {one["status"] for one in outcome(tmp_path)} == {"interrupted"}
    assert Store.open(tmp_path / "store").names() == ()


def test_ray_lost_node_restarts_its_recording(cluster: Any, tmp_path: Path) -> None:
    """This test removes a node, so it must run after the other tests of the cluster."""
    jobs = compile_job(make_job(tmp_path, "ab", wait_for="go"))
    begun: list[int] = []

    def end_a_node_once_both_are_at_work(position: int, event: Event) -> None:
        if isinstance(event, RunStarted):
            begun.append(position)
            if len(begun) == 2:
                cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
                (tmp_path / "go").touch()

    reports = list(Ray(cluster.address).map([Task(job) for job in jobs], end_a_node_once_both_are_at_work))
    assert [(report.exit_code, report.totals.written) for report in reports] == [(0, 1000)] * 2
    assert len(begun) == 3
    assert [one.rows for one in Store.open(tmp_path / "store").sequences()] == [1000, 1000]


def test_ray_without_address_starts_on_this_machine(tmp_path: Path) -> None:
    make_job(tmp_path, "ab")
    code, output = ended(ingest(tmp_path, "--executor", "ray", "--jobs", "1"))
    assert code == 0, output
    assert Store.open(tmp_path / "store").names() == ("a", "b")


def test_ray_unreachable_address_fails(tmp_path: Path) -> None:
    make_job(tmp_path, "a")
    code, output = ended(ingest(tmp_path, "--executor", "ray", "--address", "127.0.0.1:9"))
    assert code == 1
    assert "127.0.0.1:9: cannot connect to Ray" in " ".join(output.split())


def test_ray_node_without_access_to_files_fails(tmp_path: Path) -> None:
    job = compile_job(make_job(tmp_path, "a"))[0]
    here = Setting(Registrations.current(), 0, ".run-1", machine())
    (tmp_path / "store").mkdir()
    assert "one machine only" in str(out_of_reach(job, here))
    (tmp_path / "store" / here.beacon).touch()
    assert out_of_reach(job, here) is None
    assert "one machine only" in str(out_of_reach(job, replace(here, machine="another")))
    on_server = job.replace(target=DestinationSettings(host="localhost"))
    assert out_of_reach(on_server, replace(here, machine="another")) is None
    (tmp_path / "a.mcap").unlink()
    assert "the recording does not exist" in str(out_of_reach(job, here))
