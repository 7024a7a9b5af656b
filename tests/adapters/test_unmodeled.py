"""Types without an adapter keep their ROS shape."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mosaico_ingest.adapters.adapter import Adapted, UnmodeledSpec, ros_metadata
from mosaico_ingest.ontology.types import SerializationFormat
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver


def _defined(text: str, name: str = "pkg/msg/Thing") -> Definition:
    return TypeResolver().resolve(name, Embedded("ros2msg", text), ros_version=2)


def test_the_tag_is_the_short_name_and_the_columns_are_the_message(
    define: Callable[..., Definition], adapt: Callable[..., Adapted]
) -> None:
    definition = define("visualization_msgs/msg/Marker")
    bound = UnmodeledSpec().bind(definition, ros_shape(definition))
    assert bound.ontology.tag == "Marker"
    assert bound.ontology.struct == ros_shape(definition)
    adapted = adapt(UnmodeledSpec(), definition, [{"ns": "a"}, {"ns": "b"}])
    assert [row["ns"] for row in adapted.rows.to_pylist()] == ["a", "b"]
    assert bound.topic_metadata(None) == {}


def test_columns_are_shared_with_the_decoder_not_copied(define: Callable[..., Definition]) -> None:
    definition = define("std_msgs/msg/ColorRGBA")
    rows = pa.array([{"r": 1.0}], ros_shape(definition))
    adapted = UnmodeledSpec().bind(definition, ros_shape(definition)).adapt(rows, None)  # type: ignore[arg-type] - not looked at
    assert adapted.rows is rows


def test_a_field_called_like_the_envelopes_column_gets_an_underscore(adapt: Callable[..., Adapted]) -> None:
    definition = _defined("int64 timestamp_ns\nint64 timestamp_ns_\nstring name\n")
    bound = UnmodeledSpec().bind(definition, ros_shape(definition))
    assert [field.name for field in bound.ontology.struct] == ["timestamp_ns__", "timestamp_ns_", "name"]
    assert bound.topic_metadata(None) == {"renamed_fields": {"timestamp_ns__": "timestamp_ns"}}
    row: dict[str, Any] = {"timestamp_ns": 1, "timestamp_ns_": 2, "name": "n"}
    assert adapt(UnmodeledSpec(), definition, [row]).rows.to_pylist() == [
        {"timestamp_ns__": 1, "timestamp_ns_": 2, "name": "n"}
    ]


def test_a_message_without_fields_still_counts(adapt: Callable[..., Adapted]) -> None:
    adapted = adapt(UnmodeledSpec(), _defined(""), [{}, {}])
    assert len(adapted.rows) == len(adapted.index) == 2


def test_a_nested_message_without_fields_gets_the_member_ros_2_gives_it(
    adapt: Callable[..., Adapted],
) -> None:
    nothing = "=" * 80 + "\nMSG: pkg/Nothing\nuint8 A=1\n"
    definition = _defined(f"Nothing one\nNothing[2] two\nNothing[] many\nint64 timestamp_ns\n{nothing}")
    messages: list[dict[str, Any]] = [
        {"one": {}, "two": [{}, {}], "many": [{}, {}, {}], "timestamp_ns": 4},
        {"one": {}, "two": [{}, {}], "many": [], "timestamp_ns": 5},
    ]
    rows = adapt(UnmodeledSpec(), definition, messages).rows
    member = {"structure_needs_at_least_one_member": None}
    assert rows.to_pylist() == [
        {"one": member, "two": [member] * 2, "many": [member] * 3, "timestamp_ns_": 4},
        {"one": member, "two": [member] * 2, "many": [], "timestamp_ns_": 5},
    ]
    table = pa.Table.from_batches([pa.RecordBatch.from_struct_array(rows)])
    pq.write_table(table, pa.BufferOutputStream())


def test_the_spec_is_picklable_and_carries_the_layout() -> None:
    spec = UnmodeledSpec(serialization_format=SerializationFormat.RAGGED)
    assert pickle.loads(pickle.dumps(spec)) == spec  # noqa: S301 - what was just pickled
    definition = _defined("int8 a\n")
    assert (
        spec.bind(definition, ros_shape(definition)).ontology.serialization_format
        is SerializationFormat.RAGGED
    )


def test_the_origin_names_type_constants_definition_and_file() -> None:
    definition = _defined('uint8 A=1\nstring B="b"\nfloat64 C=nan\nfloat64 D=-inf\nstd_msgs/Header header\n')
    block = ros_metadata(definition, "run.bag")["_ros_"]
    assert block["msgtype"] == "pkg/msg/Thing"
    assert block["source_file"] == "run.bag"
    assert block["enums"]["A"] == 1
    assert "MSG: std_msgs/Header" in block["msgdef"]


def test_constants_without_a_number_in_json_are_spelled_out() -> None:
    enums = ros_metadata(_defined("float64 A=nan\nfloat64 B=inf\nfloat64 C=-inf\nfloat64 D=0.5\n"), "f")[
        "_ros_"
    ]["enums"]
    assert enums == {"A": "NaN", "B": "Infinity", "C": "-Infinity", "D": 0.5}
