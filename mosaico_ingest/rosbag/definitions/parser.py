"""Parse `.msg` text, and write definitions as `.msg` text."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import (
    DURATION,
    TIME,
    Constant,
    Container,
    Field,
    MessageType,
    normalize_msgtype,
    short_msgtype,
)

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


class Section(Struct, frozen=True):
    """The text of one type in a text with several; the first section may have no head."""

    kind: str
    """`MSG`, `IDL`, or empty if there is no head."""
    name: str
    text: str
    line: int
    """Number of lines of the complete text before the section."""


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


class RepeatedFieldError(BagError):
    """A field has the name of an earlier field; `where` ends in the number of its line."""

    def __init__(self, name: str, what: str, *, where: str) -> None:
        """Create the error for the field `name`."""
        super().__init__(what, where=where, hint="rename one of the two")
        self.name = name


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


def flatten(root: str, types: Mapping[str, MessageType], *, ros_version: int) -> str:
    """Return the text of `root`, followed by the types that it refers to in depth-first order, each after a separator."""
    order = dict[str, None]()
    _collect(types[root], types, order, hidden=_hidden(ros_version))
    order.pop(root, None)
    texts = [_own_text(types[root], ros_version)]
    texts += [f"{SEPARATOR}\nMSG: {short_msgtype(n)}\n{_own_text(types[n], ros_version)}" for n in order]
    return "".join(texts)


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


def spell(message: MessageType) -> str:
    """Return the `.msg` text of one type, with the field types as they are."""
    lines = [f"{constant.type} {constant.name}={constant.value}" for constant in message.constants]
    for field in message.fields:
        bound = f"<={field.string_bound}" if field.string_bound else ""
        lines.append(f"{field.type}{bound}{_brackets(field)} {field.name}")
    return "".join(f"{line}\n" for line in lines)


def _brackets(field: Field) -> str:
    if field.container is Container.SCALAR:
        return ""
    if field.container is Container.ARRAY:
        return f"[{field.size}]"
    return f"[<={field.size}]" if field.size else "[]"


_MODULE = re.compile(r"^\s*module\s+\w+\s*\{", re.MULTILINE)
_DASHES = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_SERVICE_PARTS = re.compile(r"(.+/srv/.+)_(?:Event|Request|Response)")
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"


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


def _read_section(section: Section, root: str, where: str | None) -> list[MessageType]:
    if section.kind == "IDL" or (not section.kind and _MODULE.search(section.text)):
        from mosaico_ingest.rosbag.definitions.idl import read_idl  # noqa: PLC0415 - rosbags is slow to import, and IDL is rare

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
