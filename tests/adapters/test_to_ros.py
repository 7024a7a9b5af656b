"""The way back of one object: built-in adapter classes return message objects of a rosbags typestore."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest import ROSLoader
from mosaico_ingest.adapters import ImageAdapter, PoseAdapter, Vector3Adapter
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.python import ROSAdapterBase
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.ontology import Header, Message, Pose, Time, Vector3d

HUMBLE, NOETIC = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
VECTOR = Vector3d(
    x=1, y=2, z=3, header=Header(timestamp=Time(seconds=4, nanoseconds=5), frame_id="map", sample_counter=6)
)
QUICKSTART = "configs/quickstart/drive.mcap"


def test_to_ros_default_type_is_the_first_of_the_adapter() -> None:
    message = Vector3Adapter.to_ros(VECTOR, HUMBLE)
    assert message.__msgtype__ == "geometry_msgs/msg/Vector3"
    assert (message.x, message.y, message.z) == (1, 2, 3)


@pytest.mark.parametrize("typestore", [HUMBLE, NOETIC], ids=["humble", "noetic"])
def test_to_native_stamped_type_has_header(typestore: Any) -> None:
    message = Vector3Adapter.to_native(
        Message(timestamp_ns=9, data=VECTOR),
        typestore=typestore,
        ros_msg_type="geometry_msgs/Vector3Stamped",
    )
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (4, 5, "map")
    assert getattr(message.header, "seq", 6) == 6


def test_to_ros_image_data_is_a_numpy_array() -> None:
    fields = {"height": 1, "width": 2, "encoding": "mono8", "step": 2, "data": b"\x07\x09"}
    image = ImageAdapter.to_ros(ImageAdapter.from_dict(fields), HUMBLE)
    assert image.data.dtype == np.uint8
    assert image.data.tolist() == [7, 9]


def test_to_ros_of_every_topic_serializes_to_the_recorded_fields(request: pytest.FixtureRequest) -> None:
    path = request.config.rootpath / QUICKSTART
    with ROSLoader(path, HUMBLE, ["!/camera/image_raw", "!/battery"]) as loader:
        messages = {message.topic: message for message, _ in loader}
    assert len(messages) == 8
    for message in messages.values():
        adapter = ROSBridge.get_default_adapter(message.msg_type)
        assert adapter is not None
        data = adapter.translate(message)
        restored = adapter.to_ros(data, HUMBLE, message.msg_type)
        payload = HUMBLE.serialize_cdr(restored, message.msg_type)
        again = HUMBLE.deserialize_cdr(payload, message.msg_type)
        assert str(again) == str(restored)


def test_to_ros_other_type_or_object_raises() -> None:
    with pytest.raises(AdapterError, match="Vector3d to std_msgs/msg/String"):
        Vector3Adapter.to_ros(VECTOR, HUMBLE, "std_msgs/msg/String")
    with pytest.raises(AdapterError, match="Vector3d to geometry_msgs/msg/Pose"):
        PoseAdapter.to_ros(VECTOR, HUMBLE)
    with pytest.raises(BagError, match="typestore does not define"):
        Vector3Adapter.to_ros(VECTOR, get_typestore(Stores.EMPTY))


def test_to_ros_of_a_user_adapter_raises_until_overridden() -> None:
    class Own(ROSAdapterBase[Vector3d]):
        ros_msgtype = "geometry_msgs/msg/Vector3"
        __mosaico_ontology_type__ = Vector3d

        @classmethod
        def from_dict(cls, ros_data: dict[str, Any]) -> Vector3d:
            return Vector3d(**ros_data)

    with pytest.raises(AdapterError, match="Own does not convert"):
        Own.to_native(VECTOR, typestore=HUMBLE)


def test_unpack_mosaico_msg_returns_object_and_header() -> None:
    assert Vector3Adapter.unpack_mosaico_msg(Message(timestamp_ns=9, data=VECTOR)) == (VECTOR, VECTOR.header)
    bare = Pose.model_construct(header=None)
    assert PoseAdapter.unpack_mosaico_msg(bare)[1] == Header(
        timestamp=Time(seconds=0, nanoseconds=0), frame_id=""
    )
