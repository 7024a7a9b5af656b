"""The official SDK's injector and ours, the same recording into the same server: what differs is written here."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mosaicod import Mosaicod, Topic, running

from mosaico_ingest.api import RosbagInjector
from mosaico_ingest.config import ROSInjectionConfig

RECORDING = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
RAW_IMAGES = "drive/camera/image_raw"
"""As PNG on both sides: the same pixels, but each compressor has its own bytes."""

pytestmark = [pytest.mark.interop, pytest.mark.slow]


@pytest.fixture(scope="module")
def peer() -> Iterator[Mosaicod]:
    """The server after the SDK's injector."""
    folder = os.environ.get("MOSAICO_SDK_BIN")
    injector = shutil.which("mosaicolabs.ros_injector", path=folder)
    if injector is None:
        pytest.skip("the official SDK is not on the path, nor in MOSAICO_SDK_BIN")
    with running(Mosaicod()) as server:
        words = [
            injector,
            str(RECORDING),
            "--name",
            "drive",
            "--host",
            "127.0.0.1",
            "--port",
            str(server.port),
        ]
        subprocess.run(words, check=True, capture_output=True, timeout=120)  # noqa: S603 - our own words
        yield server


@pytest.fixture(scope="module")
def ours() -> Iterator[Mosaicod]:
    """The server after our injector."""
    with running(Mosaicod()) as server:
        RosbagInjector(
            ROSInjectionConfig(
                file_path=RECORDING,
                sequence_name="drive",
                host="127.0.0.1",
                port=server.port,
                images={"/camera/image_raw": "png"},
            )
        ).run()
        yield server


def rows(topic: Topic) -> list[dict[str, Any]]:
    table = topic.table().sort_by("timestamp_ns")
    return (table.drop_columns("data") if topic.locator == RAW_IMAGES else table).to_pylist()


def test_the_calls_are_the_same_but_for_a_new_connection_to_verify(peer: Mosaicod, ours: Mosaicod) -> None:
    assert ours.calls[:6] == peer.calls[:6]
    assert Counter(ours.calls) == Counter([*peer.calls, "info"])


def test_the_bodies_have_the_same_keys(peer: Mosaicod, ours: Mosaicod) -> None:
    assert {(name, *body) for name, body in ours.bodies} == {(name, *body) for name, body in peer.bodies}


def test_topics_have_the_same_tags_formats_and_columns(peer: Mosaicod, ours: Mosaicod) -> None:
    def shape(server: Mosaicod) -> dict[str, Any]:
        return {
            name: (topic.tag, topic.format, topic.table().schema.remove_metadata())
            for name, topic in server.topics.items()
        }

    assert shape(ours).keys() == shape(peer).keys()
    for name, (tag, form, schema) in shape(ours).items():
        assert (tag, form) == shape(peer)[name][:2]
        columns = [(field.name, field.type, field.nullable) for field in schema]
        assert columns == [(field.name, field.type, field.nullable) for field in shape(peer)[name][2]]


def test_rows_have_the_same_values(peer: Mosaicod, ours: Mosaicod) -> None:
    for name, topic in ours.topics.items():
        mine, theirs = rows(topic), rows(peer.topics[name])
        assert len(mine) == len(theirs)
        for left, right in zip(mine, theirs, strict=True):
            assert repr(left) == repr(right), name


def test_what_is_said_of_the_ros_type_is_the_same(peer: Mosaicod, ours: Mosaicod) -> None:
    for name, topic in ours.topics.items():
        assert topic.metadata["_ros_"] == peer.topics[name].metadata["_ros_"]
