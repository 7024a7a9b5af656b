"""Types without an adapter keep their ROS shape."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mosaico_ingest.adapters.adapter import Adapted, UnmodeledSpec, ros_metadata
from mosaico_ingest.ontology.registry import SerializationFormat
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver


def _defined(text: str, name: str = "pkg/msg/Thing") -> Definition:
    return TypeResolver().resolve(name, Embedded("ros2msg", text), ros_version=2)


def test_unmodeled_tag_is_short_name_and_columns_are_fields(
    define: Callable[..., Definition], adapt: Callable[..., Adapted]
) -> None:
    definition = define("visualization_msgs/msg/Marker")
    bound = UnmodeledSpec().bind(definition, ros_shape(definition))
    assert bound.ontology.tag == "Marker"
    assert bound.ontology.struct == ros_shape(definition)
    adapted = adapt(UnmodeledSpec(), definition, [{"ns": "a"}, {"ns": "b"}])
    assert [row["ns"] for row in adapted.rows.to_pylist()] == ["a", "b"]
    assert bound.topic_metadata(None) == {}


def test_unmodeled_columns_share_memory(define: Callable[..., Definition]) -> None:
    definition = define("std_msgs/msg/ColorRGBA")
    rows = pa.array([{"r": 1.0}], ros_shape(definition))
    adapted = UnmodeledSpec().bind(definition, ros_shape(definition)).adapt(rows, None)  # type: ignore[arg-type] - not looked at
    assert adapted.rows is rows


def test_unmodeled_timestamp_field_gets_underscore(adapt: Callable[..., Adapted]) -> None:
    definition = _defined("int64 timestamp_ns\nint64 timestamp_ns_\nstring name\n")
    bound = UnmodeledSpec().bind(definition, ros_shape(definition))
    assert [field.name for field in bound.ontology.struct] == ["timestamp_ns__", "timestamp_ns_", "name"]
    assert bound.topic_metadata(None) == {"renamed_fields": {"timestamp_ns__": "timestamp_ns"}}
    row: dict[str, Any] = {"timestamp_ns": 1, "timestamp_ns_": 2, "name": "n"}
    assert adapt(UnmodeledSpec(), definition, [row]).rows.to_pylist() == [
        {"timestamp_ns__": 1, "timestamp_ns_": 2, "name": "n"}
    ]


def test_unmodeled_message_without_fields_is_one_row(adapt: Callable[..., Adapted]) -> None:
    adapted = adapt(UnmodeledSpec(), _defined(""), [{}, {}])
    assert len(adapted.rows) == len(adapted.index) == 2


def test_unmodeled_empty_nested_message_gets_placeholder_member(
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


def test_unmodeled_spec_pickles_with_format() -> None:
    spec = UnmodeledSpec(serialization_format=SerializationFormat.RAGGED)
    assert pickle.loads(pickle.dumps(spec)) == spec  # noqa: S301 - pickled in this line
    definition = _defined("int8 a\n")
    assert (
        spec.bind(definition, ros_shape(definition)).ontology.serialization_format
        is SerializationFormat.RAGGED
    )


def test_ros_metadata_has_type_constants_definition_and_file() -> None:
    definition = _defined('uint8 A=1\nstring B="b"\nfloat64 C=nan\nfloat64 D=-inf\nstd_msgs/Header header\n')
    block = ros_metadata(definition, "run.bag")["_ros_"]
    assert block["msgtype"] == "pkg/msg/Thing"
    assert block["source_file"] == "run.bag"
    assert block["enums"]["A"] == 1
    assert "MSG: std_msgs/Header" in block["msgdef"]


def test_ros_metadata_non_finite_constants_are_text() -> None:
    enums = ros_metadata(_defined("float64 A=nan\nfloat64 B=inf\nfloat64 C=-inf\nfloat64 D=0.5\n"), "f")[
        "_ros_"
    ]["enums"]
    assert enums == {"A": "NaN", "B": "Infinity", "C": "-Infinity", "D": 0.5}
