from __future__ import annotations

import math
import subprocess
import sys
from datetime import datetime, timezone
from enum import Enum
from typing import Annotated, Any, Literal

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

import mosaico_ingest.ontology
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology import (
    GPS,
    IMU,
    Duration,
    Floating16,
    Header,
    Image,
    ImageFormat,
    Integer8,
    Message,
    PointField,
    PointFieldDataType,
    Range,
    Serializable,
    SerializationFormat,
    Temperature,
    Time,
    Unmodeled,
    Vector3d,
    Velocity,
)
from mosaico_ingest.ontology.model import (
    FixedSize,
    Float32,
    Float64,
    Nullable,
    UInt8,
)
from mosaico_ingest.ontology.registry import (
    MODULES,
    UnknownTag,
    model,
    ontology_type,
    tags,
)


class Color(str, Enum):
    RED = "red"


class Bearing(BaseModel):
    angle: float
    sure: bool | None = None


class Sonar(Serializable):
    count: int
    ratio: float
    name: str
    live: bool
    blob: bytes
    beams: list[float]
    gain: Float32 | None = None
    rotation: Annotated[list[Float64], FixedSize(2)]
    color: Color
    mode: Literal["a", "b"]
    bearing: Bearing
    track: list[Bearing]
    raw: Annotated[bytes, pa.large_binary()]
    maybe: Annotated[int, Nullable]


class Renamed(Serializable):
    __ontology_tag__ = "my_own_tag"
    __serialization_format__ = SerializationFormat.RAGGED

    data: list[UInt8]


def test_serializable_columns_follow_annotations() -> None:
    bearing = pa.struct([pa.field("angle", pa.float64(), nullable=False), pa.field("sure", pa.bool_())])
    expected = pa.struct(
        [
            pa.field("count", pa.int64(), nullable=False),
            pa.field("ratio", pa.float64(), nullable=False),
            pa.field("name", pa.string(), nullable=False),
            pa.field("live", pa.bool_(), nullable=False),
            pa.field("blob", pa.binary(), nullable=False),
            pa.field("beams", pa.list_(pa.field("item", pa.float64())), nullable=False),
            pa.field("gain", pa.float32()),
            pa.field("rotation", pa.list_(pa.field("item", pa.float64()), 2), nullable=False),
            pa.field("color", pa.string(), nullable=False),
            pa.field("mode", pa.string(), nullable=False),
            pa.field("bearing", bearing, nullable=False),
            pa.field("track", pa.list_(pa.field("item", bearing)), nullable=False),
            pa.field("raw", pa.large_binary(), nullable=False),
            pa.field("maybe", pa.int64()),
        ]
    )
    assert Sonar.ontology_type().struct == expected


def test_serializable_subclass_is_found_by_tag() -> None:
    assert model("Sonar") is Sonar
    assert model("my_own_tag") is Renamed
    assert ontology_type("my_own_tag").serialization_format is SerializationFormat.RAGGED
    assert {"Sonar", "my_own_tag", "IMU"} <= set(tags())


def test_serializable_subclass_of_model_has_own_tag() -> None:
    class Warmer(Renamed):
        heat: float

    assert Warmer.ontology_tag() == "Warmer"
    assert Warmer.ontology_type().struct.names == ["data", "heat"]
    assert Warmer.ontology_type().serialization_format is SerializationFormat.RAGGED


def test_serializable_with_builtin_tag_raises() -> None:
    with pytest.raises(
        AdapterError, match=r"'IMU' belongs to a built-in model — rename the class or set __ontology_tag__"
    ):
        type("IMU", (Serializable,), {"__module__": __name__})


def test_model_unknown_tag_suggests_nearest() -> None:
    with pytest.raises(UnknownTag, match=r"no ontology model has the tag 'Imu' — did you mean IMU") as caught:
        model("Imu")
    assert isinstance(caught.value, KeyError)
    with pytest.raises(UnknownTag, match=r"did you mean Vector3d"):
        model("vector_3_d")
    with pytest.raises(UnknownTag, match=r"the tags are Acceleration, "):
        model("?")


@pytest.mark.parametrize(
    ("annotation", "reason"),
    [
        (dict[str, int], "has no column type"),
        (datetime, "the annotation datetime has no column type"),
        (int | str, "has no column type"),
        (tuple[int, str], "mixes item types"),
        (list[dict[str, int]], r"Odd.field\[\]"),
    ],
)
def test_struct_of_unsupported_annotation_raises_with_field(annotation: Any, reason: str) -> None:
    odd: type[Serializable] = type(
        "Odd", (Serializable,), {"__annotations__": {"field": annotation}, "__module__": __name__}
    )
    with pytest.raises(AdapterError, match=reason):
        odd.ontology_type()


class Tree(Serializable):
    children: list[Tree]


def test_struct_of_recursive_model_raises() -> None:
    with pytest.raises(AdapterError, match="Tree: a model that contains itself"):
        Tree.ontology_type()


def test_fixed_size_wrong_length_raises() -> None:
    class Pair(Serializable):
        both: Annotated[list[int], FixedSize(2)]

    with pytest.raises(AdapterError, match=r"Pair\.both: Value error, expected 2 values, found 3"):
        Pair.from_row({"both": [1, 2, 3]})


def test_to_batch_invalid_row_raises_with_index() -> None:
    class Counter(Serializable):
        count: int

    with pytest.raises(AdapterError, match="Counter: row 1: "):
        Counter.to_batch([Counter(count=1), Counter(count=2**70)])


def test_to_batch_empty_returns_typed_array() -> None:
    assert IMU.to_batch([]).type == IMU.ontology_type().struct


def test_enum_round_trip_restores_enum() -> None:
    field = PointField(name="x", offset=0, datatype=PointFieldDataType.FLOAT32, count=1)
    row = PointField.to_batch([field])[0].as_py()
    assert row == {"name": "x", "offset": 0, "datatype": 7, "count": 1}
    assert PointField.from_row(row) == field
    image = Image(data=b"\0", format=ImageFormat.RAW, width=1, height=1, stride=1, encoding="mono8")
    assert Image.from_row(Image.to_batch([image])[0].as_py()) == image


def test_from_row_struct_of_nulls_is_none() -> None:
    hollow = {"x": None, "y": None, "z": None}
    given_point = {"x": 1.0, "y": 2.0, "z": 3.0}
    assert GPS.from_row({"position": given_point, "velocity": hollow}).velocity is None


def test_float16_round_trip_restores_value() -> None:
    assert Floating16.to_batch([Floating16(data=1.5)])[0].as_py() == {"data": 1.5}


@pytest.mark.parametrize("value", [-129, 128])
def test_integer_out_of_range_raises(value: int) -> None:
    with pytest.raises(ValidationError):
        Integer8(data=value)


@pytest.mark.parametrize("nanoseconds", [-1, 10**9])
def test_time_nanoseconds_out_of_range_raises(nanoseconds: int) -> None:
    with pytest.raises(ValidationError):
        Time(seconds=0, nanoseconds=nanoseconds)


@given(st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1))
def test_time_nanoseconds_round_trip(nanoseconds: int) -> None:
    assert Time.from_nanoseconds(nanoseconds).to_nanoseconds() == nanoseconds
    assert Duration.from_nanoseconds(nanoseconds).to_milliseconds() == nanoseconds // 10**6


def test_time_converts_to_datetime_and_seconds() -> None:
    moment = datetime(2024, 5, 6, 7, 8, 9, 123456, tzinfo=timezone.utc)
    assert Time.from_datetime(moment).to_datetime() == moment
    assert Time.from_datetime(moment.replace(tzinfo=None)) == Time.from_datetime(moment)
    assert Time.from_float(-1.25) == Time(seconds=-2, nanoseconds=750_000_000)
    assert Duration.from_milliseconds(1500).to_float() == 1.5
    assert Time.now().seconds > moment.timestamp()


def test_velocity_without_components_raises() -> None:
    assert Velocity(linear=Vector3d(x=1, y=2, z=3)).angular is None
    with pytest.raises(AdapterError, match="linear or angular is required"):
        Velocity.from_row({})


@pytest.mark.parametrize("value", [0.5, 5.0, math.nan, math.inf])
def test_range_out_of_bounds_raises(value: float) -> None:
    with pytest.raises(ValidationError):
        Range(radiation_type=0, field_of_view=0.1, min_range=1, max_range=3, range=value)


def test_model_unknown_field_and_invalid_assignment_raise() -> None:
    with pytest.raises(ValidationError):
        Header(frame="map")  # type: ignore[call-arg]  # the mistake is the point
    header = Header(frame_id="map")
    with pytest.raises(ValidationError):
        header.sample_counter = -1


def test_from_list_sets_components() -> None:
    assert Vector3d.from_list([1, 2, 3]) == Vector3d(x=1, y=2, z=3)
    with pytest.raises(ValueError, match="shorter"):
        Vector3d.from_list([1, 2])


def test_temperature_converts_to_celsius() -> None:
    assert Temperature.from_celsius(20).value == 293.15
    assert Temperature(value=273.15).to_celsius() == 0


def test_unmodeled_row_round_trip() -> None:
    row = Unmodeled.from_row({"a": {"b": 1}})
    assert row.raw_data == {"a": {"b": 1}}
    assert row.to_row() == {"a": {"b": 1}}


def test_message_get_data_returns_row_of_type() -> None:
    message = Message(timestamp_ns=5, data=Integer8(data=3))
    assert message.get_data(Integer8) == Integer8(data=3)
    assert message.get_data(IMU) is None
    assert message.ontology_tag() == "Integer8"
    assert message.model_dump() == {"timestamp_ns": 5, "data": {"data": 3}}


def test_model_lookup_imports_only_its_modules() -> None:
    code = (
        "import sys, mosaico_ingest.ontology as o; assert 'pydantic' not in sys.modules;"
        "o.Joy; names = {n for n in sys.modules if n.startswith('mosaico_ingest.ontology.')};"
        "assert 'mosaico_ingest.ontology.sensors' in names and 'mosaico_ingest.ontology.perception' not in names"
    )
    subprocess.run([sys.executable, "-c", code], check=True)  # noqa: S603 - our own words


def test_ontology_exports_every_public_name() -> None:
    assert set(MODULES) < set(mosaico_ingest.ontology.__all__) <= set(dir(mosaico_ingest.ontology))
    for name in mosaico_ingest.ontology.__all__:
        assert getattr(mosaico_ingest.ontology, name).__name__ == name


def test_ontology_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'Nothing'"):
        getattr(mosaico_ingest.ontology, "Nothing")  # noqa: B009 - the type checker would see the mistake
