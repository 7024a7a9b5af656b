"""Drafted manifests describe a recording correctly."""

from __future__ import annotations

from pathlib import Path

import pytest

from mosaico_ingest.remote import as_path
from mosaico_ingest.services.draft import draft_manifest
from mosaico_ingest.services.inspection import InspectedTopic, Inspection


def draft(
    definition: str, encoding: str = "cdr", *, msgtype: str = "own_msgs/msg/A", ros_distro: str | None = None
) -> str:
    topic = InspectedTopic(
        topic="/a",
        msgtype=msgtype,
        encoding=encoding,
        count=1,
        rate_hz=None,
        definition=definition,
        adapter="Unmodeled",
        ontology="A",
        problem="is not known" if definition == "none" else None,
    )
    inspection = Inspection(
        files=("a.db3",),
        container="sqlite3",
        size_bytes=2_000,
        messages=1,
        start_ns=0,
        end_ns=0,
        topics=(topic,),
    )
    return draft_manifest(inspection, Path("a.db3"), folder=Path(), ros_distro=ros_distro)


@pytest.mark.parametrize(
    ("definition", "said"),
    [
        ("bag", "(it contains its definitions)"),
        ("distro", "(it contains no definitions; they are read as in all distros)"),
        ("package", "(it contains no definitions; they are read as in public packages)"),
    ],
)
def test_draft_manifest_states_source_of_definitions(definition: str, said: str) -> None:
    assert said in draft(definition)


def test_draft_manifest_asks_for_definitions_of_ros_messages_only() -> None:
    assert "custom_msgs: [{package: own_msgs" in draft("none")
    assert "custom_msgs" not in draft("none", "other")


def test_draft_manifest_asks_for_distro_if_distros_differ() -> None:
    marker = "visualization_msgs/msg/Marker"
    output = draft("none", msgtype=marker)
    assert f"# {marker} differs between distros" in output
    assert "# ros_distro: ros2_humble" in output
    assert "custom_msgs" not in output
    assert "custom_msgs" in draft("none", msgtype=marker, ros_distro="ros2_dashing")


def test_draft_manifest_starts_with_summary() -> None:
    assert "# sqlite3, 2.0 kB, 1 message, 0.00 s\n" in draft("bag")


def test_absolute_keeps_url_of_recording() -> None:
    inspection = Inspection(
        files=("s3://fleet/a/my drive.mcap",),
        container="mcap",
        size_bytes=1,
        messages=0,
        start_ns=None,
        end_ns=None,
        topics=(),
    )
    text = draft_manifest(inspection, as_path("s3://fleet/a/my drive.mcap?region=eu"), folder=Path("jobs"))
    assert '  path: "s3://fleet/a/my drive.mcap?region=eu"\n' in text
    assert "  name: my_drive\n" in text


def test_draft_manifest_offers_adapters_that_need_an_override() -> None:
    assert "# override: {/a: GPSFixAdapter}" in draft("bag", msgtype="gps_msgs/msg/GPSFix")
    assert "# override: {/a: MyAdapter}" in draft("bag")
