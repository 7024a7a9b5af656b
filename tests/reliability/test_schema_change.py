"""A definition that differs from earlier sequences of the family fails, warns or creates a new topic."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.recording import Report

from .conftest import RunJob, WriteBag

WriteJob = Callable[..., Path]
Session = Callable[..., Report]
FLOAT = b"\x00\x01\x00\x00" + struct.pack("<f", 1.5)
DOUBLE = b"\x00\x01\x00\x00" + struct.pack("<d", 2.5)


@pytest.fixture
def session(write_bag: WriteBag, write_job: WriteJob, run_job: RunJob) -> Session:
    """Ingest a recording `name.db3` of the family, whose topic /speed has the type `kind`."""

    def ingest(name: str, kind: str, policy: str | None = None, **sections: object) -> Report:
        write_bag({"/speed": [DOUBLE if kind == "float64" else FLOAT]}, name=name)
        messages = {"package": "own_msgs", "path": "definitions"}
        job = write_job(
            definition=f"{kind} data",
            bag={"path": f"{name}.db3", "custom_msgs": [messages]},
            **{"sequence": {"name": "{stem}"}, **sections},
            **({} if policy is None else {"on_schema_change": policy}),
        )
        return run_job(job)

    return ingest


def test_schema_change_fail_lists_differing_lines(session: Session, tmp_path: Path) -> None:
    assert session("one", "float32", "fail").status is RunStatus.COMPLETED
    assert session("two", "float32", "fail").status is RunStatus.COMPLETED
    report = session("three", "float64", "fail")
    assert (report.status, report.exit_code) == (RunStatus.FAILED, 1)
    message = "/speed: own_msgs/msg/Number differs from its definition in two: -float32 data, +float64 data"
    assert message in str(report.error)
    assert Store.open(tmp_path / "store").names() == ("one", "two")


def test_schema_change_evolve_warns_and_stores_new_columns(session: Session, tmp_path: Path) -> None:
    session("one", "float32")
    report = session("two", "float64", "evolve")
    assert report.status is RunStatus.COMPLETED
    assert any("-float32 data, +float64 data" in finding for finding in report.findings)
    store = Store.open(tmp_path / "store")
    types = [str(store.topic(name, "/speed").schema.field("data").type) for name in ("one", "two")]
    assert types == ["float", "double"]
    assert not session("three", "float64", "evolve").findings


def test_schema_change_new_topic_has_stable_name(session: Session, tmp_path: Path) -> None:
    session("one", "float32", "new_topic")
    session("two", "float64", "new_topic")
    session("three", "float32", "new_topic")
    session("four", "float64", "new_topic")
    store = Store.open(tmp_path / "store")
    names = {name: store.sequence(name).topics[0].name for name in store.names()}
    assert names["one"] == names["three"] == "/speed"
    assert names["two"] == names["four"]
    assert names["two"].startswith("/speed/v_")


def test_schema_change_new_topic_allows_appending(session: Session, tmp_path: Path) -> None:
    joined = {"sequence": {"name": "all", "if_exists": "append"}}
    session("one", "float32", "new_topic", **joined)
    assert session("two", "float64", "new_topic", **joined).status is RunStatus.COMPLETED
    assert len(Store.open(tmp_path / "store").sequence("all").topics) == 2


def test_schema_change_ignores_other_families_and_jobs_without_policy(session: Session) -> None:
    session("one", "float32")
    assert not session("two", "float64").findings
    other = {"sequence": {"name": "{stem}", "family": "others"}}
    assert session("three", "float32", "fail", **other).status is RunStatus.COMPLETED
