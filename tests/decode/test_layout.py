from __future__ import annotations

from mosaico_ingest.decode.layout import (
    FixedArrayColumn,
    FixedBlock,
    Layout,
    ListColumn,
    Loop,
    NumberColumn,
    Run,
    StructColumn,
    Text,
    TextColumn,
    compile_layout,
)
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.definitions.registry import TypeResolver


def layout_of(
    *fields: Field, others: tuple[MessageType, ...] = (), encoding: Encoding = Encoding.CDR
) -> Layout:
    root = MessageType("test/msg/Root", fields)
    types = {kind.name: kind for kind in (root, *others)}
    return compile_layout(Definition(root.name, types, Source.BAG, "", 2), encoding)


def test_layout_imu_is_two_blocks_around_a_text() -> None:
    definition = TypeResolver(Stores.ROS2_HUMBLE).resolve("sensor_msgs/msg/Imu", None, ros_version=2)
    layout = compile_layout(definition, Encoding.CDR)
    assert layout.body.steps == (FixedBlock(8, 8), Text(1, has_nul=True), FixedBlock(8, 37 * 8))


def test_layout_variable_padding_starts_new_block() -> None:
    layout = layout_of(
        Field("name", "string"), Field("a", "uint8"), Field("b", "uint32"), Field("c", "uint8")
    )
    assert layout.body.steps == (Text(1, has_nul=True), FixedBlock(1, 1), FixedBlock(4, 5))
    assert layout.record == StructColumn(
        (
            TextColumn(0, Text(1, has_nul=True)),
            NumberColumn(1, 0, "uint8"),
            NumberColumn(2, 0, "uint32"),
            NumberColumn(2, 4, "uint8"),
        )
    )


def test_layout_first_block_includes_padding() -> None:
    layout = layout_of(Field("a", "uint8"), Field("b", "float64"))
    assert layout.body.steps == (FixedBlock(8, 16),)
    assert layout.record.children[1] == NumberColumn(0, 8, "float64")


def test_layout_ros1_has_no_padding() -> None:
    layout = layout_of(Field("a", "uint8"), Field("b", "float64"), encoding=Encoding.ROS1)
    assert layout.body.steps == (FixedBlock(8, 9),)
    assert layout.record.children[1] == NumberColumn(0, 1, "float64")


def test_layout_fixed_structs_are_runs_and_others_loops() -> None:
    point = MessageType("test/msg/Point", (Field("x", "float64"), Field("ok", "bool")))
    named = MessageType("test/msg/Named", (Field("name", "string"),))
    layout = layout_of(
        Field("points", point.name, is_message=True, container=Container.SEQUENCE, size=5),
        Field("named", named.name, is_message=True, container=Container.SEQUENCE),
        others=(point, named),
    )
    run, loop = layout.body.steps
    assert run == Run(FixedBlock(8, 9), stride=16, bound=5)
    assert isinstance(loop, Loop)
    assert loop.body.steps == (Text(1, has_nul=True),)
    assert layout.record.children[1] == ListColumn(
        1, loop, StructColumn((TextColumn(0, Text(1, has_nul=True)),))
    )


def test_layout_struct_with_variable_padding_is_a_loop() -> None:
    odd = MessageType("test/msg/Odd", (Field("a", "uint8"), Field("b", "float64")))
    layout = layout_of(Field("odd", odd.name, is_message=True, container=Container.SEQUENCE), others=(odd,))
    (loop,) = layout.body.steps
    assert isinstance(loop, Loop)
    assert loop.body.steps == (FixedBlock(1, 1), FixedBlock(8, 8))


def test_layout_fixed_arrays_are_inside_one_block() -> None:
    point = MessageType("test/msg/Point", (Field("xy", "float32", container=Container.ARRAY, size=2),))
    layout = layout_of(
        Field("points", point.name, is_message=True, container=Container.ARRAY, size=3), others=(point,)
    )
    assert layout.body.steps == (FixedBlock(8, 24),)
    assert layout.record == StructColumn(
        (
            FixedArrayColumn(
                3, StructColumn((FixedArrayColumn(2, NumberColumn(0, 0, "float32", ((3, 8), (2, 4)))),))
            ),
        )
    )
