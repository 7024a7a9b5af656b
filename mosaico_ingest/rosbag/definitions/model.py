"""Message definitions as data, and the names of message types."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Protocol

import pyarrow as pa
from msgspec import Struct

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"

_BINARY_SCHEMAS = frozenset({"protobuf", "flatbuffer"})
_KINDS = frozenset({"msg", "srv", "action"})
_RENAMED = {
    "roslib/msg/Header": HEADER,
    "roslib/msg/Log": "rosgraph_msgs/msg/Log",
    "roslib/msg/Clock": "rosgraph_msgs/msg/Clock",
}


def normalize_msgtype(name: str) -> str:
    """Return `pkg/msg/Name` for `pkg/Name`, for DDS's `pkg::msg::dds_::Name_`, and for renamed types.

    Service and action parts keep their kind (`pkg/srv/Name_Request`). A name without a package is returned unchanged.
    """
    parts = [part for part in name.strip().replace("::", "/").split("/") if part]
    if "dds_" in parts:
        parts = [part for part in parts if part != "dds_"]
        parts[-1] = parts[-1].removesuffix("_")
    if len(parts) > 1 and parts[-2] not in _KINDS:
        parts.insert(-1, "msg")
    full = "/".join(parts)
    return _RENAMED.get(full, full)


def group_types(names: Iterable[str]) -> str:
    """Return type names grouped by package, such as `sensor_msgs: Image, Imu; foxglove: Log`."""
    packages: dict[str, list[str]] = {}
    for name in names:
        package, _, short = name.rpartition("/" if "/" in name else ".")
        packages.setdefault(package.partition("/")[0], []).append(short)
    return "; ".join(f"{package}: {', '.join(shorts)}" for package, shorts in packages.items())


def short_msgtype(name: str) -> str:
    """Return the name as definition texts spell it: `pkg/Name` for `pkg/msg/Name`, any other unchanged."""
    return name.replace("/msg/", "/", 1)


class Container(str, Enum):
    """How many values a field holds."""

    SCALAR = "scalar"
    ARRAY = "array"
    """A fixed number of them, without a length word."""
    SEQUENCE = "sequence"
    """Any number up to the bound, behind a length word."""


class Source(str, Enum):
    """Where a definition was found, in the order of preference."""

    BAG = "bag"
    CUSTOM = "custom"
    DISTRO = "distro"
    PACKAGE = "package"
    """A public package that no distro's core has."""


class Language(str, Enum):
    """The language of a definition."""

    ROS = "ros"
    """`.msg` or IDL."""
    PROTOBUF = "protobuf"
    """A serialized FileDescriptorSet; its text is base64."""
    JSON_SCHEMA = "jsonschema"
    """A JSON Schema; without text, the type was inferred from the messages."""


class Field(Struct, frozen=True):
    """One field: `type` is a primitive (`float64`, `string`, `wstring`, …) or a full message type name.

    Definitions in languages other than ROS also have the types `binary` and `json` (any value, as JSON text).
    """

    name: str
    type: str
    is_message: bool = False
    container: Container = Container.SCALAR
    size: int = 0
    """The length of an array, or the bound of a sequence (0: unbounded)."""
    string_bound: int = 0
    """The bound N of `string<=N` (0: unbounded); it does not affect the bytes."""
    is_required: bool = False
    """Whether a protobuf or JSON message without the field is invalid."""


class Constant(Struct, frozen=True):
    """A named value of a message type, as `uint8 STATUS_FIX=0`."""

    name: str
    type: str
    value: str | bool | int | float


class MessageType(Struct, frozen=True):
    """A message type's own fields and constants; `name` is `pkg/msg/Name`, also for ROS 1."""

    name: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...] = ()


class Definition(Struct, frozen=True):
    """A message type with all types that it refers to, and their source."""

    root: str
    types: Mapping[str, MessageType]
    source: Source
    text: str
    """ROS: the flattened `.msg` text, in which each nested type follows 80 `=` and a line `MSG: pkg/Name`.

    Other languages: the text of the embedded schema, see `Embedded`."""
    ros_version: int
    """1 or 2; determines the form of `time` and of the header. 0 for other languages than ROS."""
    language: Language = Language.ROS
    shape: pa.StructType | None = None
    """The type of the rows, if `types` cannot express it; None for ROS."""

    @property
    def message(self) -> MessageType:
        """The root type."""
        return self.types[self.root]


class Embedded(Struct, frozen=True):
    """The definition of a type as embedded in a recording."""

    encoding: str
    """`ros1msg`, `ros2msg`, `ros2idl`, `protobuf`, `jsonschema`, or another name that the recording uses."""
    text: str
    """The schema; base64 for binary schemas (`protobuf`, `flatbuffer`)."""

    @classmethod
    def from_bytes(cls, encoding: str, data: bytes) -> Embedded:
        """Return the definition for the bytes that a recording stores."""
        if encoding in _BINARY_SCHEMAS:
            return cls(encoding, base64.b64encode(data).decode())
        return cls(encoding, data.decode("utf-8", "replace"))

    def to_bytes(self) -> bytes:
        """Return the bytes that a recording stores."""
        return base64.b64decode(self.text) if self.encoding in _BINARY_SCHEMAS else self.text.encode()


class Resolver(Protocol):
    """Finds the definition of a type: embedded, custom, of the distro, or of a public package, in this order."""

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of `msgtype`, in any notation of the name.

        Raises:
            BagError: The type is unknown, or the embedded definition is invalid.
        """
        ...
