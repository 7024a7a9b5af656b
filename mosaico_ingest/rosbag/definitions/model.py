"""Message definitions as data and as `.msg` text, and the names of message types."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from functools import lru_cache
from typing import Protocol

import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import BagError

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
SEPARATOR = "=" * 80
PRIMITIVES = frozenset(
    {
        "bool", "byte", "char", "int8", "uint8", "int16", "uint16", "int32", "uint32",
        "int64", "uint64", "float32", "float64", "string", "wstring",
    }
)  # fmt: skip
"""The types that are not messages; `time` and `duration` are parsed as messages with two fields."""
BYTES = frozenset({"byte", "char", "uint8"})
"""The primitives whose sequences are binary values: `bytes` in Python."""
_SEPARATOR_LINE = re.compile(r"^={10,}[ \t\r]*(?:\n|\Z)", re.MULTILINE)
_HEAD = re.compile(r"\s*(?P<kind>MSG|IDL):[ \t]*(?P<name>\S+)[ \t\r]*(?:\n|\Z)")
_LINE = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=(?P<bound>\d+))?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z_]\w*)"
    r"(?:\s*=(?P<value>.*)|\s*(?:#.*)?|\s+(?P<default>[-+.\w'\"\[].*))"
)
_ANNOTATION = re.compile(r"@(?P<name>\w+)(?:\([^)]*\))?\s*")
_QUOTED = re.compile(r"""(?:'((?:\\.|[^'\\])*)'|"((?:\\.|[^"\\])*)")\s*(?:#.*)?""")
_MAX_SIZE = 2**31 - 1
_BUILTIN = {"time": TIME, "duration": DURATION}
_MODULE = re.compile(r"^\s*module\s+\w+\s*\{", re.MULTILINE)
_DASHES = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_SERVICE_PARTS = re.compile(r"(.+/srv/.+)_(?:Event|Request|Response)")
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"


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


class Section(Struct, frozen=True):
    """The text of one type in a text with several; the first section may have no head."""

    kind: str
    """`MSG`, `IDL`, or empty if there is no head."""
    name: str
    text: str
    line: int
    """Number of lines of the complete text before the section."""


class RepeatedFieldError(BagError):
    """A field has the name of an earlier field; `where` ends in the number of its line."""

    def __init__(self, name: str, what: str, *, where: str) -> None:
        """Create the error for the field `name`."""
        super().__init__(what, where=where, hint="rename one of the two")
        self.name = name


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


def sections(text: str) -> Iterator[Section]:
    """Split a text at its `===` lines. An empty text is one section; an empty part before a separator is none."""
    separators = list(_SEPARATOR_LINE.finditer(text))
    starts = [0, *(separator.end() for separator in separators)]
    ends = [*(separator.start() for separator in separators), len(text)]
    for start, end in zip(starts, ends, strict=True):
        head = _HEAD.match(text, start, end)
        body = head.end() if head else start
        if head or text[start:end].strip() or not separators:
            kind, name = (head["kind"], head["name"]) if head else ("", "")
            yield Section(kind, name, text[body:end], text.count("\n", 0, body))


def parse_msg(text: str, name: str, *, where: str | None = None, line: int = 0) -> MessageType:
    """Return the type that `text` defines; field types keep the notation of the text.

    `where` is the source of the text, and `line` the number of lines before it, for error messages.

    Raises:
        BagError: A line is not a field, constant or comment.
    """
    fields, constants = list[Field](), list[Constant]()
    lines: dict[str, int] = {}
    for number, raw in enumerate(text.lstrip("\ufeff").split("\n"), start=line + 1):
        content = raw.strip(" \t\r\0\f")
        if not content or content.startswith("#"):
            continue
        try:
            item = _item(content)
        except ValueError as error:
            hint = "write `type name`, `type NAME=value` or a `#` comment"
            raise BagError(
                f"cannot parse {content!r}: {error}", where=f"{where or name}:{number}", hint=hint
            ) from None
        if isinstance(item, Field):
            if item.name in lines:
                message = f"{item.name!r} is already declared in line {lines[item.name]}"
                raise RepeatedFieldError(item.name, message, where=f"{where or name}:{number}")
            lines[item.name] = number
            fields.append(item)
        elif item:
            constants.append(item)
    return MessageType(name, tuple(fields), tuple(constants))


def flatten(root: str, types: Mapping[str, MessageType], *, ros_version: int) -> str:
    """Return the text of `root`, followed by the types that it refers to in depth-first order, each after a separator."""
    order = dict[str, None]()
    _collect(types[root], types, order, hidden=_hidden(ros_version))
    order.pop(root, None)
    texts = [_own_text(types[root], ros_version)]
    texts += [f"{SEPARATOR}\nMSG: {short_msgtype(n)}\n{_own_text(types[n], ros_version)}" for n in order]
    return "".join(texts)


def spell(message: MessageType) -> str:
    """Return the `.msg` text of one type, with the field types as they are."""
    lines = [f"{constant.type} {constant.name}={constant.value}" for constant in message.constants]
    for field in message.fields:
        bound = f"<={field.string_bound}" if field.string_bound else ""
        lines.append(f"{field.type}{bound}{_brackets(field)} {field.name}")
    return "".join(f"{line}\n" for line in lines)


@lru_cache(maxsize=4096)
def read_types(text: str, root: str, *, where: str | None = None) -> Mapping[str, MessageType]:
    """Return every type that `text` defines by full name; `root` is the name of a section without head.

    Field types keep the notation of the text.

    Raises:
        BagError: A section is invalid; its location is `where` (or the type) and the line.
    """
    types, parts = dict[str, MessageType](), list(sections(text))
    for part in parts:
        for message in _read_section(part, root, where):
            types.setdefault(message.name, message)
    if all(part.kind == "MSG" for part in parts) and not text.partition(SEPARATOR)[0].strip():
        types.setdefault(root, MessageType(root, ()))  # an empty first section defines a type without fields
    return types


def _item(content: str) -> Field | Constant | None:
    while annotation := _ANNOTATION.match(content):
        if annotation["name"] == "optional":
            raise ValueError("plain CDR has no optional fields")
        content = content[annotation.end() :]
    if not content or content.startswith("#"):
        return None
    match = _LINE.fullmatch(content)
    if not match:
        raise ValueError("not a field or constant")
    kind = match["type"]
    if match["bound"] and kind not in {"string", "wstring"}:
        raise ValueError(f"{kind} cannot have a bound")
    if match["default"] and kind not in PRIMITIVES:
        raise ValueError(f"{kind} cannot have a default")
    if match["value"] is not None:
        return Constant(match["name"], kind, _value(kind, match["value"].strip()))
    container, size = _container(match["array"])
    return Field(
        match["name"],
        _BUILTIN.get(kind, kind),
        is_message=kind not in PRIMITIVES,
        container=container,
        size=size,
        string_bound=int(match["bound"] or 0),
    )


def _container(array: str | None) -> tuple[Container, int]:
    if array is None:
        return Container.SCALAR, 0
    bounded = array.startswith("[<=")
    digits = array.strip("[<=]")
    size = int(digits or 0)
    if size > _MAX_SIZE or (bounded and not digits):
        raise ValueError(f"{array} is not a valid size")
    return (Container.SEQUENCE if bounded or not digits else Container.ARRAY), size


def _value(kind: str, text: str) -> str | bool | int | float:
    """Return the value of a constant. An unquoted string extends to the end of the line."""
    if kind not in PRIMITIVES:
        raise ValueError(f"{kind} cannot be the type of a constant")
    quoted = _QUOTED.fullmatch(text)
    if quoted:
        return quoted[1] if quoted[1] is not None else quoted[2]
    if kind in {"string", "wstring"}:
        return text
    plain = text.partition("#")[0].strip()
    if kind == "bool" and plain.lower() in {"true", "false"}:
        return plain.lower() == "true"
    if kind == "bool":
        return bool(_integer(plain))
    return float(plain) if kind.startswith("float") else _integer(plain)


def _integer(text: str) -> int:
    digits = text.lstrip("+-")
    octal = len(digits) > 1 and digits.startswith("0") and digits.isdecimal()
    return int(text, 8 if octal else 0)


def _hidden(ros_version: int) -> Mapping[str, str]:
    return {TIME: "time", DURATION: "duration"} if ros_version == 1 else {}


def _collect(
    message: MessageType,
    types: Mapping[str, MessageType],
    order: dict[str, None],
    *,
    hidden: Mapping[str, str],
) -> None:
    for field in message.fields:
        if field.is_message and field.type not in order and field.type not in hidden:
            order[field.type] = None
            _collect(types[field.type], types, order, hidden=hidden)


def _own_text(message: MessageType, ros_version: int) -> str:
    hidden = _hidden(ros_version)
    fields = (
        replace(field, type=hidden.get(field.type) or short_msgtype(field.type)) for field in message.fields
    )
    return spell(replace(message, fields=tuple(fields)))


def _brackets(field: Field) -> str:
    if field.container is Container.SCALAR:
        return ""
    if field.container is Container.ARRAY:
        return f"[{field.size}]"
    return f"[<={field.size}]" if field.size else "[]"


def _read_section(section: Section, root: str, where: str | None) -> list[MessageType]:
    if section.kind == "IDL" or (not section.kind and _MODULE.search(section.text)):
        from mosaico_ingest.rosbag.definitions.rosbags_types import read_idl  # noqa: PLC0415 - rosbags is slow to import, and IDL is rare

        return read_idl(section.text, where=f"{where or root}:{section.line + 1}")
    name = normalize_msgtype(section.name) if section.name else root
    service, dashes = _SERVICE_PARTS.fullmatch(name), _DASHES.search(section.text)
    if service and dashes:
        return _read_service(service[1], section, dashes, where or root)
    return [parse_msg(section.text, name, where=where or root, line=section.line)]


def _read_service(name: str, section: Section, dashes: re.Match[str], where: str) -> list[MessageType]:
    """Return request, response and event of a service, for whose events recorders store the `.srv` text."""
    request, response = section.text[: dashes.start()], section.text[dashes.end() :]
    later = section.line + section.text.count("\n", 0, dashes.end())
    parts = [
        Field(part, f"{name}_{part.title()}", is_message=True, container=Container.SEQUENCE, size=1)
        for part in ("request", "response")
    ]
    return [
        parse_msg(request, parts[0].type, where=where, line=section.line),
        parse_msg(response, parts[1].type, where=where, line=later),
        MessageType(f"{name}_Event", (Field("info", _EVENT_INFO, is_message=True), *parts)),
    ]
