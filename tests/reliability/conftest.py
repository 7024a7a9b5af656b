"""Fixtures of recordings and jobs with known faults."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import pytest
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mosaico_ingest import api
from mosaico_ingest.report.recording import Report

START_NS = 1_700_000_000_000_000_000
CUT = b"\x00\x01\x00\x00\x01"
"""A payload that ends inside its number."""
WriteBag = Callable[..., Path]
RunJob = Callable[..., Report]


def number(value: float) -> bytes:
    return b"\x00\x01\x00\x00" + struct.pack("<d", value)


@pytest.fixture
def write_bag(tmp_path: Path) -> WriteBag:
    """Write payloads by topic, one every 10 ms, into `name.db3`, without definitions.

    Topics below /std have a standard type, the others an unknown type.
    """

    def write(topics: dict[str, Sequence[bytes]], *, name: str = "drive") -> Path:
        store = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg("float64 data", "own_msgs/msg/Number"))
        folder = tmp_path / f"{name}.folder"
        with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
            for topic, payloads in topics.items():
                msgtype = "std_msgs/msg/Float64" if topic.startswith("/std") else "own_msgs/msg/Number"
                connection = writer.add_connection(topic, msgtype, typestore=store)
                for position, payload in enumerate(payloads):
                    writer.write(connection, START_NS + position * 10_000_000, payload)
        path = next(folder.glob("*.db3")).rename(tmp_path / f"{name}.db3")
        with closing(sqlite3.connect(path)) as db:
            db.execute("DELETE FROM message_definitions")
            db.commit()
        shutil.rmtree(folder)
        return path

    return write


@pytest.fixture
def write_job(tmp_path: Path) -> Callable[..., Path]:
    """Write a manifest for `drive.db3` that defines the type Number by `definition`."""

    def write(*, definition: str = "float64 data", file: str = "job.yaml", **sections: object) -> Path:
        messages = tmp_path / "definitions"
        messages.mkdir(exist_ok=True)
        (messages / "Number.msg").write_text(definition)
        manifest = {
            "bag": {"path": "drive.db3", "custom_msgs": [{"package": "own_msgs", "path": "definitions"}]},
            "sequence": {"name": "drive"},
            "target": {"store": "store"},
            **sections,
        }
        job = tmp_path / file
        job.write_text(yaml.safe_dump(manifest))
        return job

    return write


@pytest.fixture
def run_job() -> RunJob:
    """Run a manifest of one recording and return its report."""

    def run(job: Path) -> Report:
        (report,) = api.run(api.compile_job(job)).recordings
        return report

    return run
