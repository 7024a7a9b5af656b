"""An adapter is compiled once per definition, because recordings of a batch share their types."""

from __future__ import annotations

import pickle

from msgspec.structs import replace

from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

IMU = TypeResolver(Stores.ROS2_HUMBLE).resolve("sensor_msgs/msg/Imu", None, ros_version=2)
SPEC = BY_NAME["IMUAdapter"].path


def test_bind_same_definition_is_cached() -> None:
    spec, shape = load_adapter(SPEC), ros_shape(IMU)
    own = IMU.types[IMU.root]
    other = replace(IMU, types={**IMU.types, IMU.root: replace(own, fields=own.fields[:-1])})
    first = spec.bind(IMU, shape)
    assert spec.bind(replace(IMU, text="from another recording"), shape) is first
    assert spec.bind(IMU, shape) is first

    assert spec.check(other, ros_shape(other))


def test_pickled_adapter_excludes_binding_cache() -> None:
    spec = load_adapter(SPEC)
    fresh = len(pickle.dumps(spec))
    spec.bind(IMU, ros_shape(IMU))
    assert len(pickle.dumps(spec)) == fresh
    again = pickle.loads(pickle.dumps(spec))  # noqa: S301 - pickled in this line
    assert again.bind(IMU, ros_shape(IMU)).ontology == spec.ontology
