"""The types of JSON values as columns: Arrow types, message types, and conversions of single values."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator
from typing import Any, cast

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.errors import DecodeError
from mosaico_ingest.rosbag.definitions.model import Constant, Container, Field, MessageType

_INT64 = (-(2**63), 2**63 - 1)
SCALARS = {
    "bool": pa.bool_(),
    "int64": pa.int64(),
    "float64": pa.float64(),
    "string": pa.string(),
    "binary": pa.binary(),
    "json": pa.string(),
}
"""The Arrow type of each kind that is not nested. `json` is any value as JSON text, `binary` is base64 in JSON."""


class JsonType(Struct, frozen=True):
    """The type of a column: a scalar kind of `SCALARS`, `struct` or `list`."""

    kind: str
    fields: tuple[tuple[str, JsonType], ...] = ()
    """The fields of a struct."""
    item: JsonType | None = None
    """The type of a list's items."""
    name: str = ""
    """The name of a struct, for adapters; empty if its schema has no title."""
    required: frozenset[str] = frozenset()
    """The fields of a struct that are written as null if they are null; others are omitted."""
    constants: tuple[Constant, ...] = ()
    """The named values of a struct's fields."""

    @property
    def arrow(self) -> pa.DataType:
        """The Arrow type of the column."""
        if self.kind == "struct":
            return self.struct
        if self.item is not None:
            is_struct = self.item.kind == "struct"
            return pa.list_(pa.field("element" if is_struct else "item", self.item.arrow))
        return SCALARS[self.kind]

    @property
    def struct(self) -> pa.StructType:
        """The Arrow type of a struct."""
        return pa.struct([pa.field(name, field.arrow) for name, field in self.fields])

    def contains(self, kind: str) -> bool:
        """Return whether the type or a type in it has a kind."""
        return (
            self.kind == kind
            or (self.item is not None and self.item.contains(kind))
            or any(field.contains(kind) for _, field in self.fields)
        )

    def to_column(self, value: Any, path: str, undeclared: set[str]) -> Any:  # noqa: ANN401 - any JSON value
        """Return a JSON value as a value of the column; add the fields that the type lacks to `undeclared`.

        Raises:
            DecodeError: The value does not fit the column.
        """
        if value is None:
            return None
        if self.kind == "struct":
            if not isinstance(value, dict):
                raise _misfit(value, "an object", path)
            members = cast("dict[str, Any]", value)
            if members.keys() - (names := dict(self.fields)).keys():
                undeclared |= {f"{path}.{name}"[2:] for name in members if name not in names}
            return {
                name: field.to_column(members.get(name), f"{path}.{name}", undeclared)
                for name, field in self.fields
            }
        if self.item is not None:
            if not isinstance(value, list):
                raise _misfit(value, "an array", path)
            items = cast("list[Any]", value)
            return [self.item.to_column(item, f"{path}[{n}]", undeclared) for n, item in enumerate(items)]
        return _scalar(self.kind, value, path)

    def to_json(self, value: Any) -> Any:  # noqa: ANN401 - any JSON value
        """Return a value of the column as JSON."""
        if value is None:
            return None
        if self.kind == "struct":
            return {
                name: field.to_json(value.get(name))
                for name, field in self.fields
                if value.get(name) is not None or name in self.required
            }
        if self.item is not None:
            return [self.item.to_json(item) for item in value]
        if self.kind == "binary":
            return base64.b64encode(value).decode()
        return json.loads(value) if self.kind == "json" else value


ANY = JsonType("json")
BINARY = JsonType("binary")


def struct_of(fields: dict[str, JsonType], **properties: Any) -> JsonType:  # noqa: ANN401 - the properties of JsonType
    """Return a struct; JSON text without fields, because no container can store a struct without fields."""
    return JsonType("struct", tuple(fields.items()), **properties) if fields else ANY


def list_of(item: JsonType) -> JsonType:
    """Return a list of items."""
    return JsonType("list", item=item)


def _scalar(kind: str, value: Any, path: str) -> Any:  # noqa: ANN401 - any JSON value
    match kind:
        case "json":
            return json.dumps(value, ensure_ascii=False, separators=(",", ":"))
        case "bool" if isinstance(value, bool):
            return value
        case "int64" if (
            not isinstance(value, bool) and isinstance(value, (int, float)) and value == value // 1
        ):
            if not _INT64[0] <= value <= _INT64[1]:
                raise DecodeError(f"{path}: {value} does not fit int64", rule="json-value")
            return int(value)
        case "float64" if not isinstance(value, bool) and isinstance(value, (int, float)):
            return _float(value, path)
        case "string" if isinstance(value, str):
            try:
                value.encode()
            except UnicodeEncodeError:
                raise DecodeError(
                    f"{path}: the text contains half of a surrogate pair", rule="json-value"
                ) from None
            return value
        case "binary" if isinstance(value, str):
            try:
                return base64.b64decode(value, validate=True)
            except (binascii.Error, ValueError) as error:
                raise DecodeError(f"{path}: the text is not base64: {error}", rule="json-value") from None
        case _:
            raise _misfit(value, kind, path)


def _float(value: float, path: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise DecodeError(f"{path}: the integer does not fit float64", rule="json-value") from None


def _misfit(value: object, kind: str, path: str) -> DecodeError:
    return DecodeError(f"{path}: {json.dumps(value)[:80]} is not {kind}", rule="json-value")


def message_types(root: JsonType, name: str) -> dict[str, MessageType]:
    """Return the message type of a struct and of all structs in it, by name."""
    types: dict[str, MessageType] = {}
    _add_types(root, name, types)
    return types


def _add_types(struct: JsonType, name: str, types: dict[str, MessageType]) -> None:
    fields: list[Field] = []
    types[name] = MessageType(name, ())  # keeps the order: outer types first
    for field, inner in struct.fields:
        container = Container.SCALAR if inner.item is None else Container.SEQUENCE
        item = inner.item or inner
        is_required = field in struct.required
        if item.kind != "struct":
            kind = item.kind if item.item is None else "json"  # `Field` cannot express lists of lists
            fields.append(Field(field, kind, container=container, is_required=is_required))
            continue
        nested = _free_name(item, f"{name}.{field}", types)
        if nested not in types:
            _add_types(item, nested, types)
        fields.append(Field(field, nested, is_message=True, container=container, is_required=is_required))
    types[name] = MessageType(name, tuple(fields), struct.constants)


def _free_name(struct: JsonType, path: str, types: dict[str, MessageType]) -> str:
    """Return the title of a struct, or its path if another struct has the same title."""
    other = types.get(struct.name)
    is_used = other is not None and list(_names(struct)) != [field.name for field in other.fields]
    return path if is_used or not struct.name else struct.name


def _names(struct: JsonType) -> Iterator[str]:
    return (name for name, _ in struct.fields)
