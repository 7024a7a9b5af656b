from __future__ import annotations

import pyarrow as pa
import pytest

from mosaico_ingest.errors import DecodeError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import (
    Constant,
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

POINT = MessageType("test/msg/Point", (Field("x", "float32"),))


def shape_of(*fields: Field, others: tuple[MessageType, ...] = (POINT,)) -> pa.StructType:
    root = MessageType("test/msg/Root", fields, (Constant("NONE", "uint8", 0),))
    types = {kind.name: kind for kind in (root, *others)}
    return ros_shape(Definition(root.name, types, Source.BAG, "", 2))


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        (Field("v", "bool"), pa.bool_()),
        (Field("v", "byte"), pa.uint8()),
        (Field("v", "char"), pa.uint8()),
        (Field("v", "int8"), pa.int8()),
        (Field("v", "uint64"), pa.uint64()),
        (Field("v", "float32"), pa.float32()),
        (Field("v", "string", string_bound=7), pa.string()),
        (Field("v", "wstring"), pa.string()),
        (Field("v", "float64", container=Container.SEQUENCE), pa.list_(pa.float64())),
        (Field("v", "float64", container=Container.SEQUENCE, size=3), pa.list_(pa.float64())),
        (Field("v", "float64", container=Container.ARRAY, size=3), pa.list_(pa.float64(), 3)),
        (Field("v", "uint8", container=Container.SEQUENCE), pa.binary()),
        (Field("v", "char", container=Container.SEQUENCE, size=8), pa.binary()),
        (Field("v", "int8", container=Container.SEQUENCE), pa.list_(pa.int8())),
        (Field("v", "uint8", container=Container.ARRAY, size=16), pa.list_(pa.uint8(), 16)),
    ],
)
def test_ros_shape_maps_ros_types_to_arrow_types(field: Field, expected: pa.DataType) -> None:
    assert shape_of(field) == pa.struct([pa.field("v", expected)])


def test_ros_shape_list_of_messages_names_child_like_field() -> None:
    shape = shape_of(Field("points", "test/msg/Point", is_message=True, container=Container.SEQUENCE))
    point = pa.struct([pa.field("x", pa.float32())])
    assert shape == pa.struct([pa.field("points", pa.list_(pa.field("points", point)))])
    assert shape.field("points").type.field(0).name == "points"


def test_ros_shape_stamp_is_equal_in_ros1_and_ros2() -> None:
    stamp = pa.struct([pa.field("sec", pa.int32()), pa.field("nanosec", pa.uint32())])
    for distro, version in ((Stores.ROS1_NOETIC, 1), (Stores.ROS2_HUMBLE, 2)):
        definition = TypeResolver(distro).resolve("std_msgs/msg/Header", None, ros_version=version)
        assert ros_shape(definition).field("stamp").type == stamp


def test_ros_shape_empty_message_is_empty_struct() -> None:
    assert shape_of() == pa.struct([])


def test_ros_shape_recursive_type_raises() -> None:
    loop = MessageType("test/msg/Loop", (Field("next", "test/msg/Loop", is_message=True),))
    with pytest.raises(DecodeError, match="test/msg/Loop contains itself"):
        shape_of(Field("loop", "test/msg/Loop", is_message=True), others=(loop,))


def test_ros_shape_unknown_primitive_raises() -> None:
    with pytest.raises(DecodeError, match="field v has the unknown type float128"):
        shape_of(Field("v", "float128"))
