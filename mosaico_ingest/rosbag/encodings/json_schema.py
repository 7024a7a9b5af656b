"""JSON Schemas as definitions and columns, and as msgspec types that confirm valid messages.

The columns of a schema:

* An object with `properties` is a struct; an array with `items` is a list. `integer` is int64, `number` is float64, and
  a string with `contentEncoding: base64` is binary. `null` beside another type makes no difference: every column is
  nullable, and an absent property is null.
* Everything else, such as a property of several types or an object without `properties`, is JSON text.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Annotated, Any, Literal, cast

import msgspec
import pyarrow as pa
from jsonschema import Draft202012Validator, validators
from jsonschema.exceptions import SchemaError
from jsonschema.protocols import Validator
from msgspec import UNSET, Meta, Struct, UnsetType
from referencing import Registry

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.rosbag.definitions.model import (
    Constant,
    Container,
    Definition,
    Embedded,
    Field,
    Language,
    MessageType,
    Source,
)

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
_UNNAMED = "json"
"""The type name of channels without a schema."""
_MAX_COLUMNS = 20_000
_KINDS = {"boolean": "bool", "integer": "int64", "number": "float64", "string": "string"}
_ANNOTATIONS = frozenset({
    "$schema", "$id", "id", "$comment", "title", "description", "default", "examples", "definitions", "$defs", "format",
    "contentEncoding", "contentMediaType", "readOnly", "writeOnly", "deprecated",
})  # fmt: skip
"""Keywords that reject no value; `format` is not checked."""
_LIMITS = {"minimum": "ge", "maximum": "le", "exclusiveMinimum": "gt", "exclusiveMaximum": "lt"}
_SIZES = {
    "string": {"minLength": "min_length", "maxLength": "max_length"},
    "array": {"minItems": "min_length", "maxItems": "max_length"},
}


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


def message_types(root: JsonType, name: str) -> dict[str, MessageType]:
    """Return the message type of a struct and of all structs in it, by name."""
    types: dict[str, MessageType] = {}
    _add_types(root, name, types)
    return types


def read_schema(name: str, embedded: Embedded | None) -> Definition:
    """Return the definition of a JSON channel. Without properties, its shape is None, and must be inferred.

    Raises:
        BagError: The schema is not a JSON Schema, or it refers to other documents.
    """
    name = name or _UNNAMED
    text = "" if embedded is None else embedded.text
    if embedded is not None and embedded.encoding != "jsonschema":
        raise BagError(
            f"the JSON channel has a schema in {embedded.encoding!r}; it needs a JSON Schema", where=name
        )
    kind = json_type(text, name) if text.strip() else ANY
    if kind.kind != "struct":
        return Definition(name, {name: MessageType(name, ())}, Source.BAG, text, 0, Language.JSON_SCHEMA)
    types = message_types(kind, name)
    return Definition(name, types, Source.BAG, text, 0, Language.JSON_SCHEMA, kind.struct)


def json_type(text: str, name: str) -> JsonType:
    """Return the type of the columns of a JSON Schema.

    Raises:
        BagError: The text is not a JSON Schema, or it refers to other documents.
    """
    return _Columns(_parse(text, name)).root()


def validator_of(text: str, name: str) -> Validator:
    """Return the validator of a JSON Schema, in the draft that it names; the default is 2020-12."""
    schema = _parse(text, name)
    return _draft_of(schema)(schema, registry=Registry())  # this registry never downloads schemas


def confirming_type(text: str, name: str) -> Any:  # noqa: ANN401 - a type
    """Return a type that msgspec decodes only from valid messages; None if the schema has no such type.

    A message that msgspec rejects may still be valid; `validator_of` decides about it.
    """
    schema = _parse(text, name)
    try:
        kind = _Confirming(schema).type_of(schema, ())
        msgspec.json.Decoder(kind)
    except (_Unconfirmable, TypeError, ValueError):
        return None
    return kind


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


def _draft_of(schema: Any) -> type[Validator]:  # noqa: ANN401 - an object or a boolean
    return validators.validator_for(schema, default=Draft202012Validator)


@lru_cache(maxsize=64)
def _parse(text: str, name: str) -> Any:  # noqa: ANN401 - an object or a boolean
    try:
        schema = json.loads(text)
        _draft_of(schema).check_schema(schema)
    except (ValueError, RecursionError) as error:
        raise BagError(f"the schema is not JSON: {error}", where=name) from error
    except SchemaError as error:
        raise BagError(
            f"the schema is not a JSON Schema: {error.json_path}: {error.message}", where=name
        ) from error
    for target in _references(schema):
        if not target.startswith("#"):
            raise BagError(f"the JSON Schema refers to another document: {target}", where=name)
        if _lookup(schema, target) is None:
            raise BagError(f"the JSON Schema refers to {target}, which it does not contain", where=name)
    return schema


def _references(schema: Any) -> Iterator[str]:  # noqa: ANN401 - any JSON value
    if isinstance(schema, list):
        for item in cast("list[Any]", schema):
            yield from _references(item)
    elif isinstance(schema, dict):
        for key, value in cast("dict[str, Any]", schema).items():
            if key in {"$ref", "$dynamicRef", "$recursiveRef"} and isinstance(value, str):
                yield value
            else:
                yield from _references(value)


def _lookup(schema: Any, target: str) -> Any:  # noqa: ANN401 - any JSON value
    """Return the schema that a JSON pointer refers to; None if there is none."""
    for part in target.removeprefix("#").split("/")[1:]:
        key = part.replace("~1", "/").replace("~0", "~")
        if not isinstance(schema, dict) or key not in schema:
            return None
        schema = cast("dict[str, Any]", schema)[key]
    return schema


class _Columns:
    """Derives the columns of one schema."""

    def __init__(self, schema: Any) -> None:  # noqa: ANN401 - an object or a boolean
        self._schema = schema
        self._count = 0

    def root(self) -> JsonType:
        return self._type(self._schema, ())

    def _type(self, schema: Any, above: tuple[str, ...]) -> JsonType:  # noqa: ANN401 - an object or a boolean
        if not isinstance(schema, dict):
            return ANY
        node = cast("dict[str, Any]", schema)
        reference = node.get("$ref")
        if reference is not None:
            return (
                ANY
                if reference in above
                else self._type(_lookup(self._schema, reference), (*above, reference))
            )
        if (only := _without_null(node)) is not node:
            return self._type(only, above)
        return self._typed(node, above)

    def _typed(self, node: dict[str, Any], above: tuple[str, ...]) -> JsonType:
        kinds = _kinds_of(node)
        if kinds == {"object"}:
            return self._struct(node, above)
        if kinds == {"array"}:
            items = node.get("items")
            return list_of(self._type(items, above)) if isinstance(items, dict) else ANY
        if kinds == {"string"} and node.get("contentEncoding") == "base64":
            return BINARY
        if kinds == {"integer", "number"}:
            return JsonType("float64")
        return JsonType(_KINDS[next(iter(kinds))]) if len(kinds) == 1 else ANY

    def _struct(self, node: dict[str, Any], above: tuple[str, ...]) -> JsonType:
        properties: dict[str, Any] = node.get("properties") or {}
        self._count += len(properties)
        if self._count > _MAX_COLUMNS:
            raise BagError(f"the JSON Schema has more than {_MAX_COLUMNS} properties")
        fields = {name: self._type(schema, above) for name, schema in properties.items()}
        return struct_of(
            fields,
            name=str(node.get("title") or ""),
            required=frozenset(node.get("required") or ()),
            constants=tuple(_constants(properties)),
        )


def _without_null(node: dict[str, Any]) -> dict[str, Any]:
    """Return the other schema of `anyOf: [schema, {type: null}]`, or the same schema if it has another form."""
    for keyword in ("anyOf", "oneOf"):
        options = node.get(keyword)
        if isinstance(options, list) and not node.keys() - {keyword} - _ANNOTATIONS:
            others = [one for one in cast("list[Any]", options) if one != {"type": "null"}]
            if len(others) == 1 and isinstance(others[0], dict):
                return cast("dict[str, Any]", others[0])
    return node


def _kinds_of(node: Mapping[str, Any]) -> set[str]:
    """Return the types of JSON values that a schema allows, except null; empty if it does not name them."""
    type_names = node.get("type")
    if isinstance(type_names, str):
        return {type_names} - {"null"}
    if isinstance(type_names, list):
        return {str(one) for one in cast("list[Any]", type_names)} - {"null"}
    if "properties" in node:
        return {"object"}
    values = _allowed_values(node)
    if values and all(isinstance(value, str) for value in values):
        return {"string"}
    if values and all(isinstance(value, int) and not isinstance(value, bool) for value in values):
        return {"integer"}
    return set()


def _allowed_values(node: Mapping[str, Any]) -> list[Any]:
    """Return the values that `enum`, `const` or a `oneOf` of constants lists."""
    if isinstance(node.get("enum"), list):
        return list(node["enum"])
    if "const" in node:
        return [node["const"]]
    options = node.get("oneOf")
    if isinstance(options, list) and options and all(_is_constant(one) for one in cast("list[Any]", options)):
        return [one["const"] for one in cast("list[Any]", options)]
    return []


def _is_constant(node: object) -> bool:
    return isinstance(node, dict) and "const" in node and not node.keys() - {"const"} - _ANNOTATIONS


def _constants(properties: Mapping[str, Any]) -> Iterator[Constant]:
    """Yield the titled integers of the properties; a title with two values is preceded by its property's name."""
    values: dict[str, int] = {}
    for field, schema in properties.items():
        options = schema.get("oneOf") if isinstance(schema, dict) else None
        for one in cast("list[Any]", options or []):
            if (
                not _is_constant(one)
                or not isinstance(one.get("title"), str)
                or type(one["const"]) is not int
            ):
                continue
            name, number = one["title"], one["const"]
            if values.get(name, number) != number:
                name = f"{field}_{name}"
            if name not in values:
                values[name] = number
                yield Constant(name, "int64", number)


class _Unconfirmable(Exception):  # noqa: N818 - control flow inside this module
    """A schema has a keyword without an equivalent in msgspec."""


class _Confirming:
    """Builds msgspec types for one schema."""

    def __init__(self, schema: Any) -> None:  # noqa: ANN401 - an object or a boolean
        self._schema = schema
        self._count = 0

    def type_of(self, schema: Any, above: tuple[str, ...]) -> Any:  # noqa: ANN401 - a schema and a type
        """Return the type of a schema; its values are a subset of the valid ones."""
        if schema is True or schema == {}:
            return Any
        if not isinstance(schema, dict):
            raise _Unconfirmable
        node = {
            key: value for key, value in cast("dict[str, Any]", schema).items() if key not in _ANNOTATIONS
        }
        if "$ref" in node:
            if len(node) > 1 or node["$ref"] in above:
                raise _Unconfirmable
            return self.type_of(_lookup(self._schema, node["$ref"]), (*above, node["$ref"]))
        if not node:
            return Any
        if (only := _without_null(node)) is not node:
            return self.type_of(only, above) | None
        values = _allowed_values(node)
        if values:
            return self._literal(node, values)
        type_names = node.pop("type", "object" if "properties" in node else None)
        kinds = cast("list[str]", type_names if isinstance(type_names, list) else [type_names])
        others = [kind for kind in kinds if kind != "null"]
        if len(others) > 1 and node:
            raise _Unconfirmable
        union = None if len(others) < len(kinds) else self._kind(others.pop(), node, above)
        for kind in others:
            union = union | self._kind(kind, node, above)
        return union

    def _literal(self, node: dict[str, Any], values: list[Any]) -> Any:  # noqa: ANN401 - a type
        if node.keys() - {"type", "enum", "const", "oneOf"} or len(node.keys() - {"type"}) > 1:
            raise _Unconfirmable
        kinds = _kinds_of({"type": node["type"]}) if "type" in node else {"string", "integer"}
        names = {str: {"string"}, int: {"integer", "number"}}
        if not all(names.get(type(value), set()) & kinds for value in values) or len(set(values)) < len(
            values
        ):
            raise _Unconfirmable
        return Literal[tuple(values)]

    def _kind(self, kind: str, node: dict[str, Any], above: tuple[str, ...]) -> Any:  # noqa: ANN401 - a type
        match kind:
            case "object":
                return self._object(node, above)
            case "array":
                items = node.get("items", True)
                _allow_only(node, {"items", *_SIZES["array"]})
                return _limited(list[self.type_of(items, above)], node, _SIZES["array"])
            case "string":
                _allow_only(node, {"pattern", *_SIZES["string"]})
                pattern = {"pattern": "pattern"} if "pattern" in node else {}
                return _limited(str, node, {**_SIZES["string"], **pattern})
            case "integer" | "number":
                _allow_only(node, set(_LIMITS))
                return _limited(int if kind == "integer" else float, node, _LIMITS)
            case "boolean":
                _allow_only(node, set())
                return bool
            case _:
                raise _Unconfirmable

    def _object(self, node: dict[str, Any], above: tuple[str, ...]) -> Any:  # noqa: ANN401 - a type
        _allow_only(node, {"properties", "required", "additionalProperties"})
        extra = node.get("additionalProperties", True)
        properties: dict[str, Any] = node.get("properties") or {}
        required: set[str] = set(node.get("required") or ())
        if not isinstance(extra, bool) or required - properties.keys():
            raise _Unconfirmable
        if not properties and extra:
            return dict
        self._count += len(properties)
        if self._count > _MAX_COLUMNS:
            raise _Unconfirmable
        fields: list[Any] = []
        for number, (name, schema) in enumerate(properties.items()):
            kind = self.type_of(schema, above)
            if name in required:
                fields.append((f"f{number}", kind, msgspec.field(name=name)))
            else:
                fields.append((f"f{number}", kind | UnsetType, msgspec.field(default=UNSET, name=name)))
        return msgspec.defstruct("Message", fields, kw_only=True, forbid_unknown_fields=not extra, gc=False)


def _allow_only(node: dict[str, Any], keywords: set[str]) -> None:
    if node.keys() - keywords:
        raise _Unconfirmable


def _limited(kind: Any, node: dict[str, Any], limits: Mapping[str, str]) -> Any:  # noqa: ANN401 - types
    """Return a type with the limits of a schema."""
    values = {limits[keyword]: node[keyword] for keyword in limits if keyword in node}
    if any(isinstance(value, bool) for value in values.values()):  # `exclusiveMinimum` of draft 4
        raise _Unconfirmable
    limited: Any = Annotated  # the arguments are known when the recording is opened
    return limited[kind, Meta(**values)] if values else kind
