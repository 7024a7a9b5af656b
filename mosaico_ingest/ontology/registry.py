"""Find ontology models and their Arrow columns by tag.

`columns.json` contains the columns of the built-in models, so that a run does not import them. A type is the name of
an Arrow type, a mapping for a struct, or a list with the element type and an optional length; a column whose name ends
in `?` is nullable.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import pyarrow as pa

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat

if TYPE_CHECKING:
    from mosaico_ingest.ontology.model import Serializable

DEFINED: dict[str, type[Serializable]] = {}
"""Model classes by tag; a later class with the same tag replaces an earlier one."""

MODULES: Mapping[str, str] = MappingProxyType(
    {
        tag: module
        for module, names in {
            "geometry": (
                "Acceleration ForceTorque FrameTransform Inertia MotionState Point2d Point3d Polygon Pose Quaternion "
                "RobotPath Transform Vector2d Vector3d Vector4d Velocity"
            ),
            "header": "Duration Header Time",
            "imaging": "CameraInfo CompressedImage Image ROI",
            "ranging": (
                "GridCells LaserScan Lidar MapMetadata MultiEchoLaserScan OccupancyGrid PointCloud2 PointField "
                "RGBDCamera Radar Range StereoCamera ToFCamera"
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

COLUMNS_FILE = Path(__file__).with_name("columns.json")

EncodedType: TypeAlias = "str | list[Any] | dict[str, Any]"
"""An Arrow type in `columns.json`."""
_arrow: Any = pa
"""pyarrow, whose stubs do not accept a `str` as the name of a type."""


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


class UnknownTag(AdapterError, KeyError):  # noqa: N818 - the condition, as `NothingMatched`
    """No model has the tag."""


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
