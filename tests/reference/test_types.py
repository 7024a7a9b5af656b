"""The message types of the reference: adapter, ontology type, and a message of each through the converter."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import pytest

from mosaico_ingest import ROSBridge, adapters
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.ontology import String
from mosaico_ingest.ros_bridge import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape

STATUS = {"status": 0, "service": 1}
VALUES: dict[str, dict[str, Any]] = {
    "sensor_msgs/msg/Image": {"encoding": "mono8", "height": 1, "width": 1, "step": 1, "data": b"\x07"},
    "sensor_msgs/msg/CompressedImage": {"format": "jpeg", "data": b"\xff\xd8\xff"},
}
"""Values without which a message is refused."""


def zero(kind: Any) -> Any:
    """Return a value of an Arrow type in which every number is zero."""
    if pa.types.is_struct(kind):
        return {field.name: zero(field.type) for field in kind}
    if pa.types.is_fixed_size_list(kind):
        return [zero(kind.value_type)] * kind.list_size
    if pa.types.is_list(kind) or pa.types.is_large_list(kind):
        return []
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return ""
    if pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_fixed_size_binary(kind):
        return b""
    return False if pa.types.is_boolean(kind) else 0


def translated(msgtype: str, **values: Any) -> Any:
    fields = zero(ros_shape(DefinitionFinder().find(msgtype)))
    message = ROSMessage(5, "/topic", msgtype, {**fields, **VALUES.get(msgtype, {}), **values})
    return ROSBridge.from_ros_message(message).data


@pytest.mark.parametrize(
    ("package", "names", "tag", "name"),
    [
        pytest.param(
            "geometry_msgs",
            "Pose PoseStamped PoseWithCovariance PoseWithCovarianceStamped",
            "Pose",
            "PoseAdapter",
            marks=pytest.mark.promise("type-pose"),
        ),
        pytest.param(
            "geometry_msgs",
            "Twist TwistStamped TwistWithCovariance TwistWithCovarianceStamped",
            "Velocity",
            "TwistAdapter",
            marks=pytest.mark.promise("type-twist"),
        ),
        pytest.param(
            "geometry_msgs",
            "Accel AccelStamped AccelWithCovariance AccelWithCovarianceStamped",
            "Acceleration",
            "AccelAdapter",
            marks=pytest.mark.promise("type-accel"),
        ),
        pytest.param(
            "geometry_msgs",
            "Vector3 Vector3Stamped",
            "Vector3d",
            "Vector3Adapter",
            marks=pytest.mark.promise("type-vector3"),
        ),
        pytest.param(
            "geometry_msgs",
            "Point PointStamped",
            "Point3d",
            "PointAdapter",
            marks=pytest.mark.promise("type-point"),
        ),
        pytest.param(
            "geometry_msgs",
            "Quaternion QuaternionStamped",
            "Quaternion",
            "QuaternionAdapter",
            marks=pytest.mark.promise("type-quaternion"),
        ),
        pytest.param(
            "geometry_msgs",
            "Transform TransformStamped",
            "Transform",
            "TransformAdapter",
            marks=pytest.mark.promise("type-transform"),
        ),
        pytest.param(
            "geometry_msgs",
            "Wrench WrenchStamped",
            "ForceTorque",
            "WrenchAdapter",
            marks=pytest.mark.promise("type-wrench"),
        ),
        pytest.param(
            "nav_msgs",
            "Odometry",
            "MotionState",
            "OdometryAdapter",
            marks=pytest.mark.promise("type-odometry"),
        ),
        pytest.param(
            "nmea_msgs",
            "Sentence",
            "NMEASentence",
            "NMEASentenceAdapter",
            marks=pytest.mark.promise("type-nmea"),
        ),
        pytest.param(
            "sensor_msgs", "Image", "Image", "ImageAdapter", marks=pytest.mark.promise("type-image")
        ),
        pytest.param(
            "sensor_msgs",
            "CompressedImage",
            "CompressedImage",
            "CompressedImageAdapter",
            marks=pytest.mark.promise("type-compressed-image"),
        ),
        pytest.param("sensor_msgs", "Imu", "IMU", "IMUAdapter", marks=pytest.mark.promise("type-imu")),
        pytest.param("sensor_msgs", "NavSatFix", "GPS", "GPSAdapter", marks=pytest.mark.promise("type-gps")),
        pytest.param(
            "sensor_msgs",
            "NavSatStatus",
            "GPSStatus",
            "NavSatStatusAdapter",
            marks=pytest.mark.promise("type-gps-status"),
        ),
        pytest.param(
            "sensor_msgs",
            "CameraInfo",
            "CameraInfo",
            "CameraInfoAdapter",
            marks=pytest.mark.promise("type-camera-info"),
        ),
        pytest.param(
            "sensor_msgs", "RegionOfInterest", "ROI", "ROIAdapter", marks=pytest.mark.promise("type-roi")
        ),
        pytest.param(
            "sensor_msgs",
            "JointState",
            "RobotJoint",
            "RobotJointAdapter",
            marks=pytest.mark.promise("type-joint-state"),
        ),
        pytest.param(
            "sensor_msgs",
            "BatteryState",
            "BatteryState",
            "BatteryStateAdapter",
            marks=pytest.mark.promise("type-battery"),
        ),
        pytest.param(
            "tf2_msgs",
            "TFMessage",
            "FrameTransform",
            "FrameTransformAdapter",
            marks=pytest.mark.promise("type-tf"),
        ),
        pytest.param(
            "sensor_msgs",
            "PointCloud2",
            "PointCloud2",
            "PointCloudAdapter",
            marks=pytest.mark.promise("type-point-cloud"),
        ),
    ],
)
def test_type_is_converted_by_its_adapter(package: str, names: str, tag: str, name: str) -> None:
    for msgtype in (f"{package}/msg/{each}" for each in names.split()):
        adapter = ROSBridge.get_default_adapter(msgtype)
        assert adapter is getattr(adapters, name)
        assert translated(msgtype).ontology_tag() == tag


@pytest.mark.parametrize(
    ("names", "prefix", "value"),
    [
        pytest.param("Int8 Int16 Int32 Int64", "Integer", -3, marks=pytest.mark.promise("type-integers")),
        pytest.param("UInt8 UInt16 UInt32 UInt64", "Unsigned", 3, marks=pytest.mark.promise("type-unsigned")),
        pytest.param("Float32 Float64", "Floating", 0.5, marks=pytest.mark.promise("type-floats")),
        pytest.param("Bool", "Boolean", True, marks=pytest.mark.promise("type-bool")),
    ],
)
def test_standard_number_keeps_its_value(names: str, prefix: str, value: object) -> None:
    for name in names.split():
        data = translated(f"std_msgs/msg/{name}", data=value)
        size = "".join(character for character in name if character.isdigit())
        assert (data.ontology_tag(), data.data) == (prefix + size, value)


@pytest.mark.promise("type-string")
def test_standard_string_keeps_its_text() -> None:
    assert translated("std_msgs/msg/String", data="hello") == String(data="hello")
