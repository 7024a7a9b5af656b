"""`ROSInjectionConfig`: it validates its arguments and converts each to one form."""

from __future__ import annotations

import pickle
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores as RosbagsStores

from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.values import (
    IfExists,
    LoaderErrorPolicy,
    ServerTarget,
    SessionLevelErrorPolicy,
    Stores,
    StoreTarget,
    TimeBound,
    TopicLevelErrorPolicy,
)


class MyCustomRGBDAdapter:
    """A placeholder for an adapter of a user."""


def config(**fields: Any) -> ROSInjectionConfig:
    return ROSInjectionConfig(**{"file_path": "a.bag", "sequence_name": "run", **fields})


def test_config_accepts_the_example_of_the_reference() -> None:
    configuration = ROSInjectionConfig(
        file_path=Path("data/session_01.db3"),
        sequence_name="test_ros_sequence",
        metadata={"driver_version": "v2.1", "weather": "sunny", "location": "test_track_A"},
        topics=["/cam*"],
        ros_distro=Stores.ROS2_HUMBLE,
        custom_msgs=[("my_custom_pkg", Path("./definitions/my_pkg/"), Stores.ROS2_HUMBLE)],
        adapter_override={"/camera/depth/points": MyCustomRGBDAdapter},
        log_level="WARNING",
        on_error=SessionLevelErrorPolicy.Report,
        topics_on_error=TopicLevelErrorPolicy.Raise,
    )
    assert configuration.paths == (Path("data/session_01.db3"),)
    assert configuration.topics == ("/cam*",)
    assert (
        configuration.adapter_overrides
        == configuration.adapter_override
        == {"/camera/depth/points": MyCustomRGBDAdapter}
    )
    assert configuration.target == StoreTarget(Path("mosaico"))
    assert pickle.loads(pickle.dumps(configuration)) == configuration  # noqa: S301 - our own bytes


@pytest.mark.parametrize(
    "name",
    [
        "metadata",
        "topics",
        "custom_msgs",
        "adapter_override",
        "adapter_overrides",
        "topic_metadata",
        "serialization_formats",
    ],
)
def test_config_none_for_a_collection_is_empty(name: str) -> None:
    assert config(**{name: None}) == config()


def test_config_accepts_other_enumerations_by_value() -> None:
    class Policy(Enum):  # as in the official SDK
        Ignore = "ignore"

    configuration = config(ros_distro=RosbagsStores.ROS2_HUMBLE, topics_on_error={"/gps": Policy.Ignore})
    assert configuration.ros_distro is Stores.ROS2_HUMBLE
    assert configuration.topic_policy("/gps") is TopicLevelErrorPolicy.Ignore


def test_config_converts_strings_to_enumerations() -> None:
    configuration = config(
        ros_distro="ros2_humble",
        on_error="delete",
        topics_on_error="ignore",
        messages_on_error="raise",
        topics="/imu",
    )
    assert configuration.ros_distro is Stores.ROS2_HUMBLE
    assert configuration.on_error is SessionLevelErrorPolicy.Delete
    assert configuration.topics_on_error is TopicLevelErrorPolicy.Ignore
    assert configuration.messages_on_error is LoaderErrorPolicy.RAISE
    assert configuration.topics == ("/imu",)


def test_config_adapter_overrides_is_an_alias_of_adapter_override() -> None:
    configuration = config(adapter_overrides={"/a": MyCustomRGBDAdapter})
    assert configuration.adapter_override == {"/a": MyCustomRGBDAdapter}
    with pytest.raises(ManifestError, match="disagree on '/a'"):
        config(adapter_overrides={"/a": MyCustomRGBDAdapter}, adapter_override={"/a": "Other"})


def test_config_target_is_derived_from_store_and_host() -> None:
    assert config().target == StoreTarget(Path("mosaico"))
    assert config(store="s").target == StoreTarget(Path("s"))
    assert config(host="h").target == ServerTarget("h", 6726)
    server = config(host="h", port=1, mosaico_api_key="k", tls_cert_path="c.pem").target
    assert server == ServerTarget("h", 1, "k", Path("c.pem"), tls=True)
    assert "api_key" not in repr(server)


def test_config_update_if_exists_means_append() -> None:
    assert config(update_if_exists=True).if_exists is IfExists.APPEND


def test_topic_policy_prefers_exact_name_then_glob_then_default() -> None:
    configuration = config(topics_on_error={"default": "finalize", "/gps/*": "ignore", "/gps/fix": "raise"})
    assert configuration.topic_policy("/gps/fix") is TopicLevelErrorPolicy.Raise
    assert configuration.topic_policy("/gps/other") is TopicLevelErrorPolicy.Ignore
    assert configuration.topic_policy("/imu") is TopicLevelErrorPolicy.Finalize
    assert config(topics_on_error={"/a": "ignore"}).topic_policy("/b") is TopicLevelErrorPolicy.Raise


def test_config_repr_hides_the_api_key() -> None:
    assert "s3cret" not in repr(config(host="h", mosaico_api_key="s3cret"))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"file_path": []}, "file_path is empty"),
        ({"ros_distro": "humble"}, "ros_distro is 'humble' — allowed: "),
        ({"on_error": "explode"}, "on_error is 'explode'"),
        ({"topics_on_error": {"/a": "no"}}, "topics_on_error\\['/a'\\] is 'no'"),
        ({"log_level": "LOUD"}, "log_level is 'LOUD'"),
        ({"store": "s", "host": "h"}, "store 's' and host 'h' are two targets"),
        ({"port": 0}, "port is 0"),
        ({"mosaico_api_key": "k"}, "no host is named"),
        ({"update_if_exists": True, "if_exists": "replace"}, "append and if_exists says replace"),
        ({"every": {"/a": 0}}, "every\\['/a'\\] is 0"),
        ({"images": {"/a": "jpg"}}, "images\\['/a'\\] is 'jpg'"),
        ({"jobs": 0}, "jobs is 0"),
        ({"sequence_name": "a b"}, "sequence name 'a b'"),
        ({"metadata": {"a.b": 1}}, "metadata key 'a.b'"),
        ({"metadata": {"mosaico_ingest": 1}}, "the metadata key 'mosaico_ingest'"),
        ({"metadata": [1]}, "metadata is \\[1\\]"),
        ({"custom_msgs": [("pkg", "dir")]}, "custom_msgs has \\('pkg', 'dir'\\)"),
        ({"topic_metadata": {"/a": {"x/y": 1}}}, "metadata key 'x/y'"),
        ({"rename": {"/a": "/b c"}}, "topic name '/b c'"),
        ({"rename": {"/a/*": "/b"}}, "rename\\['/a/\\*'\\] is for every topic of a glob"),
    ],
)
def test_config_invalid_value_raises_with_the_value(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(IngestError, match=message):
        config(**fields)


def test_time_bound_relative_counts_from_start_or_end() -> None:
    assert TimeBound(5, relative=True).at(100, 200) == 105
    assert TimeBound(-5, relative=True).at(100, 200) == 195
    assert TimeBound(5).at(100, 200) == 5
