"""Ontology types: their Arrow columns and units, and the models by tag.

`columns.json` contains the columns of the built-in models, so that a run does not import them. A type is the name of
an Arrow type, a mapping for a struct, or a list with the element type and an optional length; a column whose name ends
in `?` is nullable.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.lazy import cache_by_identity

if TYPE_CHECKING:
    from mosaico_ingest.ontology.model import Serializable
PLAIN_TYPES: Mapping[pa.DataType, pa.DataType] = {
    pa.large_string(): pa.string(),
    pa.string_view(): pa.string(),
    pa.large_binary(): pa.binary(),
    pa.binary_view(): pa.binary(),
}
"""The plain type of texts and bytes by their large and view types."""
_arrays: Any = pa
"""pyarrow, whose stubs do not accept `type` together with `mask`."""
_arrow: Any = pa
"""pyarrow, whose stubs do not accept a `str` as the name of a type."""
_KEPT_BYTES = 1 << 20
_Fill: TypeAlias = Callable[[Any], Any]
"""Fills an array, or returns it unchanged if there is nothing to fill."""
EncodedType: TypeAlias = "str | list[Any] | dict[str, Any]"
"""An Arrow type in `columns.json`."""
COLUMNS_FILE = Path(__file__).with_name("columns.json")
MODULES: Mapping[str, str] = MappingProxyType(
    {
        tag: module
        for module, names in {
            "geometry": (
                "Acceleration ForceTorque FrameTransform Inertia MotionState Point2d Point3d Polygon Pose Quaternion "
                "RobotPath Transform Vector2d Vector3d Vector4d Velocity"
            ),
            "model": "Duration Header Time",
            "perception": (
                "CameraInfo CompressedImage GridCells Image LaserScan Lidar MapMetadata MultiEchoLaserScan OccupancyGrid "
                "PointCloud2 PointField RGBDCamera ROI Radar Range StereoCamera ToFCamera"
            ),
            "scalars": (
                "Boolean Floating16 Floating32 Floating64 Integer16 Integer32 Integer64 Integer8 "
                "String Unmodeled Unsigned16 Unsigned32 Unsigned64 Unsigned8"
            ),
            "sensors": "BatteryState GPS GPSStatus IMU Joy Magnetometer NMEASentence Pressure RobotJoint Temperature",
        }.items()
        for tag in names.split()
    }
)
"""The module of each built-in tag; tags are class names."""
DEFINED: dict[str, type[Serializable]] = {}
"""Model classes by tag; a later class with the same tag replaces an earlier one."""


class SerializationFormat(str, Enum):
    """The layout of a topic on the platform."""

    DEFAULT = "default"
    RAGGED = "ragged"
    IMAGE = "image"


class OntologyType(Struct, frozen=True):
    """The type of a topic's rows; `struct` has every column except `timestamp_ns`."""

    tag: str
    struct: pa.StructType
    serialization_format: SerializationFormat = SerializationFormat.DEFAULT

    @property
    def fingerprint(self) -> str:
        """Identifier of the columns, which readers compare."""
        return fingerprint(self.struct)


class UnknownTag(AdapterError, KeyError):  # noqa: N818 - the condition, as `NothingMatched`
    """No model has the tag."""


@cache_by_identity
def fingerprint(struct: pa.StructType) -> str:
    """Return the first ten hex digits of the SHA-1 of the struct's text; top-level large and view types count as plain."""
    fields = [
        pa.field(field.name, PLAIN_TYPES.get(field.type) or field.type, field.nullable) for field in struct
    ]
    return hashlib.sha1(str(pa.struct(fields)).encode(), usedforsecurity=False).hexdigest()[:10]


class RequiredFields:
    """Fills the required fields of a struct type; the constructor finds them once for all batches of a topic."""

    def __init__(self, kind: pa.StructType) -> None:
        self._fill = _fill_of(kind)

    def fill(self, rows: pa.StructArray) -> pa.StructArray:
        """Return the rows with zeros in required fields that are null because their struct is null.

        No value that can be seen changes. Parquet's writer refuses `struct<a: int32 not null>` with a null in `a`
        although the struct itself is null there.
        """
        return rows if self._fill is None else cast("pa.StructArray", self._fill(rows))  # a struct stays one


class NullRows:
    """Null rows of one type, with zeros in required fields; small arrays are built once."""

    def __init__(self, kind: Any) -> None:  # noqa: ANN401 - any Arrow type; the stubs have no common base with children
        self._kind = kind
        self._fill = _fill_of(kind)
        self._kept: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without the cached rows."""
        return NullRows, (self._kind,)

    def of(self, count: int) -> Any:  # noqa: ANN401 - an Arrow array
        """Return `count` null rows."""
        if self._kept is not None and count <= len(self._kept):
            return self._kept.slice(0, count)
        rows: Any = pa.nulls(count, self._kind)
        rows = rows if self._fill is None else self._fill(rows)
        if rows.nbytes <= _KEPT_BYTES:
            self._kept = rows
        return rows


def _fill_of(kind: Any) -> _Fill | None:  # noqa: ANN401 - any Arrow type
    """Return a function that fills arrays of a type, None if nothing inside is required."""
    if pt.is_struct(kind):
        return _struct_fill(list(kind))
    if pt.is_fixed_size_list(kind):
        inner = _fill_of(kind.value_type)
        return None if inner is None else lambda array: _fill_fixed(array, inner)
    if pt.is_list(kind):
        inner = _fill_of(kind.value_type)
        return None if inner is None else lambda array: _fill_list(array, inner)
    return None


def _struct_fill(fields: list[pa.Field[Any]]) -> _Fill | None:
    inner = [_fill_of(field.type) for field in fields]
    watched = [
        (position, fill, field.nullable)
        for position, (field, fill) in enumerate(zip(fields, inner, strict=True))
        if fill is not None or not field.nullable
    ]

    def fill_struct(array: Any) -> Any:  # noqa: ANN401 - an Arrow array
        new_children: dict[int, Any] = {}
        for position, fill, nullable in watched:
            child = array.field(position)
            new = child if fill is None else fill(child)
            if not nullable and child.null_count:
                new = _without_nulls(new)
            if new is not child:
                new_children[position] = new
        if not new_children:
            return array
        children = [new_children[i] if i in new_children else array.field(i) for i in range(len(fields))]
        mask = pc.is_null(array) if array.null_count else None
        return pa.StructArray.from_arrays(children, fields=fields, mask=mask)

    return fill_struct if watched else None


def _fill_fixed(array: Any, fill: _Fill) -> Any:  # noqa: ANN401 - an Arrow array
    size = array.type.list_size
    values = array.values.slice(array.offset * size, len(array) * size)
    filled = fill(values)
    if filled is values:
        return array
    mask = pc.is_null(array) if array.null_count else None
    return _arrays.FixedSizeListArray.from_arrays(filled, type=array.type, mask=mask)


def _fill_list(array: Any, fill: _Fill) -> Any:  # noqa: ANN401 - an Arrow array
    values = array.values
    filled = fill(values)
    if filled is values:
        return array
    # A null offset is a null list; `mask` does not go with a slice.
    absent = np.append(array.is_null().to_numpy(zero_copy_only=False), False)
    offsets = pa.array(array.offsets.to_numpy(), pa.int32(), mask=absent)
    return pa.ListArray.from_arrays(offsets, filled, type=array.type)


def _without_nulls(array: Any) -> Any:  # noqa: ANN401 - an Arrow array
    """Return the values without their null mask."""
    if pt.is_struct(array.type):
        children = [array.field(position) for position in range(array.type.num_fields)]
        return pa.StructArray.from_arrays(children, fields=list(array.type))
    if pt.is_list(array.type):
        return pc.if_else(pc.is_null(array), pa.scalar([], array.type), array)
    return pc.fill_null(array, _zero(array.type))


def _zero(kind: pa.DataType) -> pa.Scalar[Any]:
    if pt.is_string(kind) or pt.is_large_string(kind):
        return pa.scalar("", kind)
    if pt.is_binary(kind) or pt.is_large_binary(kind):
        return pa.scalar(b"", kind)
    return pa.scalar(False if pt.is_boolean(kind) else 0, kind)


@cache
def builtin_type(tag: str) -> OntologyType:
    """Return the ontology type of a built-in tag; raises KeyError for any other tag."""
    entry = _entries()[tag]
    return OntologyType(tag, pa.struct(_fields(entry["columns"])), SerializationFormat(entry["format"]))


@cache
def _entries() -> dict[str, dict[str, Any]]:
    return json.loads(COLUMNS_FILE.read_bytes())


def _fields(columns: Mapping[str, EncodedType]) -> list[pa.Field[Any]]:
    return [
        pa.field(name.removesuffix("?"), _type(kind), nullable=name.endswith("?"))
        for name, kind in columns.items()
    ]


def _type(kind: EncodedType) -> pa.DataType:
    if isinstance(kind, str):
        return _arrow.type_for_alias(kind)
    if isinstance(kind, dict):
        return pa.struct(_fields(kind))
    return pa.list_(_type(kind[0]), *kind[1:])


def encode_fields(struct: pa.StructType) -> dict[str, EncodedType]:
    """Return the fields of a struct as in `columns.json`."""
    return {field.name + "?" * field.nullable: _encode_type(field.type) for field in struct}


def _encode_type(kind: Any) -> EncodedType:  # noqa: ANN401 - the stubs hide the members of nested types
    if pa.types.is_struct(kind):
        return encode_fields(kind)
    if pa.types.is_fixed_size_list(kind):
        return [_encode_type(kind.value_type), kind.list_size]
    return [_encode_type(kind.value_type)] if pa.types.is_list(kind) else str(kind)


def model(tag: str) -> type[Serializable]:
    """Return the class of a tag: the last one defined, otherwise the built-in.

    Raises:
        UnknownTag: No model has the tag; the hint names the nearest tags.
    """
    if tag not in DEFINED and tag in MODULES:
        import_module(f"mosaico_ingest.ontology.{MODULES[tag]}")
    if tag in DEFINED:
        return DEFINED[tag]
    by_letters = {_letters(each): each for each in tags()}
    near = [by_letters[name] for name in get_close_matches(_letters(tag), by_letters, n=3)]
    hint = f"did you mean {' or '.join(near)}?" if near else f"the tags are {', '.join(tags())}"
    raise UnknownTag(f"no ontology model has the tag {tag!r}", hint=hint)


def ontology_type(tag: str) -> OntologyType:
    """Return the ontology type of a tag.

    Raises:
        UnknownTag: No model has the tag; the hint names the nearest tags.
    """
    return builtin_type(tag) if tag in MODULES else model(tag).ontology_type()


def tags() -> tuple[str, ...]:
    """Return all tags in alphabetical order."""
    return tuple(sorted({*MODULES, *DEFINED}))


def _letters(tag: str) -> str:
    """Return a tag without underscores and upper case, so that older spellings such as `vector_3_d` match."""
    return tag.replace("_", "").lower()


_POSE = {"position": "m"}
_VELOCITY = {"linear": "m/s", "angular": "rad/s"}
_ACCELERATION = {"linear": "m/s²", "angular": "rad/s²"}
_CLOUD = {"x": "m", "y": "m", "z": "m"}
_BEAMS = {"range": "m", "azimuth": "rad", "elevation": "rad"}
_SWEEP = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}
_MAP = {"resolution": "m", "width": "cells", "height": "cells", "origin.position": "m"}
_REGION = {"offset": "px", "height": "px", "width": "px"}


def _below(prefix: str, units: Mapping[str, str]) -> dict[str, str]:
    return {f"{prefix}.{path}": unit for path, unit in units.items()}


UNITS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "Acceleration": _ACCELERATION,
        "BatteryState": {
            "voltage": "V",
            "temperature": "°C",
            "current": "A",
            "charge": "Ah",
            "capacity": "Ah",
            "design_capacity": "Ah",
            "cell_voltage": "V",
            "cell_temperature": "°C",
        },
        "CameraInfo": {
            "height": "px",
            "width": "px",
            "intrinsic_parameters": "px",
            "projection_parameters": "px",
            **_below("roi", _REGION),
        },
        "ForceTorque": {"force": "N", "torque": "N·m"},
        "FrameTransform": {"transforms.translation": "m"},
        "GPS": {"position.x": "°", "position.y": "°", "position.z": "m", "velocity": "m/s"},
        "GridCells": {"cell_width": "m", "cell_height": "m", "cells": "m"},
        "IMU": {"acceleration": "m/s²", "angular_velocity": "rad/s"},
        "Image": {"width": "px", "height": "px", "stride": "B"},
        "Inertia": {"mass": "kg", "center_of_mass": "m", "inertia": "kg·m²"},
        "LaserScan": _SWEEP,
        "Lidar": {**_CLOUD, **_BEAMS},
        "Magnetometer": {"magnetic_field": "T"},
        "MapMetadata": _MAP,
        "MotionState": {
            **_below("pose", _POSE),
            **_below("velocity", _VELOCITY),
            **_below("acceleration", _ACCELERATION),
        },
        "MultiEchoLaserScan": _SWEEP,
        "OccupancyGrid": {**_below("info", _MAP), "data": "%"},
        "PointCloud2": {"point_step": "B", "row_step": "B"},
        "Polygon": {"points": "m"},
        "Pose": _POSE,
        "Pressure": {"value": "Pa"},
        "RGBDCamera": _CLOUD,
        "ROI": _REGION,
        "Radar": {
            **_CLOUD,
            **_BEAMS,
            "rcs": "dBm²",
            "snr": "dB",
            **dict.fromkeys(("doppler_velocity", "vx", "vy", "vx_comp", "vy_comp", "radial_speed"), "m/s"),
            **dict.fromkeys(("ax", "ay"), "m/s²"),
        },
        "Range": {"field_of_view": "rad", **dict.fromkeys(("min_range", "max_range", "range"), "m")},
        "RobotPath": _below("poses", _POSE),
        "StereoCamera": _CLOUD,
        "Temperature": {"value": "K"},
        "ToFCamera": _CLOUD,
        "Transform": {"translation": "m"},
        "Velocity": _VELOCITY,
    }
)
"""Units by ontology tag and column; the unit of a struct applies to its components."""
_WITHOUT_UNIT = frozenset({"header", "covariance", "covariance_type", "variance", "variance_type"})
"""Members of a struct that do not have the unit of its components."""


def column_unit(tag: str, path: str) -> str:
    """Return the unit of a column such as `acceleration.x`, or an empty text if it has none or none is known."""
    units = UNITS.get(tag, {})
    steps = path.split(".")
    for length in range(len(steps), 0, -1):
        unit = units.get(".".join(steps[:length]))
        if unit is not None:
            return "" if _WITHOUT_UNIT.intersection(steps[length:]) else unit
    return ""
