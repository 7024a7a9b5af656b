"""`ROSInjectionConfig` builds a valid job or names the argument that is wrong."""

from __future__ import annotations

import pickle
from dataclasses import fields
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores as RosbagsStores

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.model import ErrorPolicy, Job
from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.job.validation import keys_at
from mosaico_ingest.job.values import (
    IfExists,
    LoaderErrorPolicy,
    PluginTarget,
    ServerTarget,
    SessionLevelErrorPolicy,
    Stores,
    StoreTarget,
    TimeBound,
    TopicLevelErrorPolicy,
)


class MyCustomRGBDAdapter:
    """Stands for a user's adapter."""


def config(**fields: Any) -> ROSInjectionConfig:
    return ROSInjectionConfig(**{"file_path": "a.bag", "sequence_name": "run", **fields})


def job(**fields: Any) -> Job:
    return config(**fields).job


@pytest.mark.promise("config-arguments")
def test_config_arguments_become_sections_of_a_job_that_can_be_pickled() -> None:
    result = config(
        file_path=Path("data/session_01.db3"),
        topics=["/cam*"],
        custom_msgs=[("my_custom_pkg", Path("./definitions/my_pkg/"), Stores.ROS2_HUMBLE)],
        adapter_override={"/camera/depth/points": MyCustomRGBDAdapter},
    )
    assert result.job.paths == (Path("data/session_01.db3"),)
    assert result.job.topics == ("/cam*",)
    assert result.job.adapters.override == {"/camera/depth/points": MyCustomRGBDAdapter}
    assert result.job.destination == StoreTarget(Path("mosaico"))
    assert pickle.loads(pickle.dumps(result)).job == result.job  # noqa: S301 - our own bytes


def test_config_key_of_each_argument_exists_in_manifest() -> None:
    schema = job_schema()
    paths = [field.metadata["key"] for field in fields(ROSInjectionConfig) if "key" in field.metadata]
    assert [path for path in paths if path[-1] not in keys_at(schema, path[:-1])] == []


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
def test_config_none_stands_for_default(name: str) -> None:
    assert job(**{name: None}) == job()


def test_config_other_enumerations_are_converted_by_value() -> None:
    class Policy(Enum):  # as the official SDK has it
        Ignore = "ignore"

    result = job(ros_distro=RosbagsStores.ROS2_HUMBLE, topics_on_error={"/gps": Policy.Ignore})
    assert result.bag.ros_distro is Stores.ROS2_HUMBLE
    assert result.on_error.for_topic("/gps") is TopicLevelErrorPolicy.Ignore


def test_config_words_are_converted_to_enumerations() -> None:
    result = job(
        ros_distro="ros2_humble",
        on_error="delete",
        topics_on_error="ignore",
        topics="/imu",
        manifest={"on_error": {"message": "raise"}},
    )
    assert result.bag.ros_distro is Stores.ROS2_HUMBLE
    assert result.on_error == ErrorPolicy(
        session=SessionLevelErrorPolicy.Delete,
        topic=TopicLevelErrorPolicy.Ignore,
        message=LoaderErrorPolicy.RAISE,
    )
    assert result.topics == ("/imu",)


def test_config_plural_spelling_of_overrides_is_equivalent() -> None:
    assert job(adapter_overrides={"/a": MyCustomRGBDAdapter}).adapters.override == {"/a": MyCustomRGBDAdapter}
    with pytest.raises(ManifestError, match="differ for '/a'"):
        config(adapter_overrides={"/a": MyCustomRGBDAdapter}, adapter_override={"/a": "Other"})


def test_config_destination_is_default_store_store_or_server() -> None:
    assert job().destination == StoreTarget(Path("mosaico"))
    assert job(store="s").destination == StoreTarget(Path("s"))
    assert job(host="h").destination == ServerTarget("h", 6726)
    server = job(host="h", port=1, mosaico_api_key="k", tls_cert_path="c.pem").destination
    assert server == ServerTarget("h", 1, "k", Path("c.pem"), tls=True)
    assert "api_key" not in repr(server)
    plugin = {"target": {"type": "lake", "options": {"bucket": "b"}}}
    assert job(manifest=plugin).destination == PluginTarget("lake", {"bucket": "b"})


def test_config_update_if_exists_is_append() -> None:
    assert job(update_if_exists=True).sequence.if_exists is IfExists.APPEND


def test_error_policy_for_topic_prefers_exact_name_then_glob_then_default() -> None:
    policy = job(topics_on_error={"default": "finalize", "/gps/*": "ignore", "/gps/fix": "raise"}).on_error
    assert policy.for_topic("/gps/fix") is TopicLevelErrorPolicy.Raise
    assert policy.for_topic("/gps/other") is TopicLevelErrorPolicy.Ignore
    assert policy.for_topic("/imu") is TopicLevelErrorPolicy.Finalize
    assert job(topics_on_error={"/a": "ignore"}).on_error.for_topic("/b") is TopicLevelErrorPolicy.Raise


def test_job_settings_of_topic_take_each_setting_from_first_glob_that_defines_it() -> None:
    settings = {
        "/cam/*": {"every": 3},
        "*": {"image": "png"},
        "/cam/left": {"image": "raw", "rename": "/left"},
    }
    result = job(manifest={"topic_settings": settings})
    left, right = result.settings_of("/cam/left"), result.settings_of("/cam/right")
    assert (left.every, left.image, left.rename) == (3, "raw", "/left")
    assert (right.every, right.image, right.rename) == (3, "png", None)


def test_config_repr_hides_api_key() -> None:
    result = config(host="h", mosaico_api_key="s3cret")
    assert "s3cret" not in repr(result)
    assert "s3cret" not in repr(result.job)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"file_path": []}, "file_path is empty"),
        ({"ros_distro": "humble"}, "ros_distro is 'humble' — allowed: "),
        ({"on_error": "explode"}, "on_error is 'explode'"),
        ({"topics_on_error": {"/a": "no"}}, "topics_on_error\\['/a'\\] is 'no'"),
        ({"log_level": "LOUD"}, "log_level is 'LOUD'"),
        ({"store": "s", "host": "h"}, "store and host are two destinations"),
        ({"store": "s", "manifest": {"target": {"type": "lake"}}}, "store and type are two destinations"),
        ({"port": 0}, "port is 0"),
        ({"mosaico_api_key": "k"}, "requires host"),
        (
            {"update_if_exists": True, "manifest": {"sequence": {"if_exists": "replace"}}},
            "sets sequence.if_exists to 'append', and `manifest` to 'replace'",
        ),
        ({"manifest": {"bag": {"path": "b.bag"}}}, "sets bag.path to 'a.bag', and `manifest` to 'b.bag'"),
        ({"manifest": {"topic_settings": {"/a": {"every": 0}}}}, r"\['/a'\]\['every'\] is 0"),
        ({"manifest": {"topic_settings": {"/a": {"every": 10**30}}}}, r"\['/a'\]\['every'\] is 1000"),
        ({"manifest": {"topic_settings": {"/a": {"image": "jpg"}}}}, r"\['/a'\]\['image'\] is 'jpg'"),
        ({"manifest": {"run": {"jobs": 0}}}, r"manifest\['run'\]\['jobs'\] is 0"),
        ({"manifest": {"nonsense": 0}}, r"manifest\['nonsense'\] is 0"),
        ({"sequence_name": "a b"}, "sequence name 'a b'"),
        ({"metadata": {"a.b": 1}}, "metadata key 'a.b'"),
        ({"metadata": {"mosaico_ingest": 1}}, "the metadata key 'mosaico_ingest'"),
        ({"metadata": [1]}, "metadata is \\[1\\]"),
        ({"custom_msgs": [("pkg", "dir")]}, "custom_msgs has \\('pkg', 'dir'\\)"),
        ({"topic_metadata": {"/a": {"x/y": 1}}}, "metadata key 'x/y'"),
        ({"manifest": {"topic_settings": {"/a": {"rename": "/b c"}}}}, "topic name '/b c'"),
        ({"manifest": {"topic_settings": {"/a/*": {"rename": "/b"}}}}, r"'/a/\*'.*'/b'"),
    ],
)
def test_config_invalid_value_is_refused_with_name_and_value(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        config(**fields)


def test_time_bound_negative_offset_counts_from_end() -> None:
    assert TimeBound(5, relative=True).at(100, 200) == 105
    assert TimeBound(-5, relative=True).at(100, 200) == 195
    assert TimeBound(5).at(100, 200) == 5
