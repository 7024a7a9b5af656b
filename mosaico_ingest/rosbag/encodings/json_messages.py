"""JSON messages: validation by jsonschema, dictionaries, and types inferred from samples.

Types that differ between messages are united: objects have the fields of all messages, and numbers with a fraction in
any message are float64. Values of types that have nothing in common become JSON text.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any, cast

import pyarrow as pa
from jsonschema.exceptions import best_match
from msgspec.structs import replace
from referencing.exceptions import Unresolvable

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.encodings.json_schema import (
    ANY,
    JsonType,
    json_type,
    list_of,
    message_types,
    struct_of,
    validator_of,
)

_MAX_REASON = 200
_MAX_FIELDS = 1000
"""Number of fields beyond which an object is a map with arbitrary keys, and becomes JSON text."""
_INT64_BITS = 63
_JSON_TYPES = {"bool": "boolean", "int64": "integer", "float64": "number", "string": "string"}
_ORIGINAL = "#/$defs/original"
_UNKNOWN = JsonType("null")
"""The type of a value that has been null in all messages."""


class JsonCodec:
    """Converts single messages of one definition; jsonschema decides whether they are valid."""

    def __init__(self, definition: Definition) -> None:
        self.columns = columns_of(definition)
        text = definition.text
        self._validator = validator_of(text, definition.root) if text.strip() else None

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        """Return the message's fields by name.

        Raises:
            DecodeError: The payload is not a JSON object, violates the schema, or has a value that fits no column.
        """
        return self.read(payload, set())

    def read(self, payload: bytes, undeclared: set[str]) -> dict[str, Any]:
        """Return the message's fields by name, as `to_dict`; add the fields without a column to `undeclared`."""
        try:
            value = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise DecodeError(f"the message is not JSON: {error}", rule="json-syntax") from None
        if not isinstance(value, dict):
            raise DecodeError(f"the message is not an object: {json.dumps(value)[:80]}", rule="json-syntax")
        self._validate(value)
        return self.columns.to_column(value, "$", undeclared)

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message in the form that `to_dict` returns.

        Raises:
            BagError: A value cannot be written as JSON.
        """
        try:
            return json.dumps(
                self.columns.to_json(values), ensure_ascii=False, separators=(",", ":")
            ).encode()
        except (TypeError, ValueError, AttributeError) as error:
            raise BagError(f"the values do not match their columns: {error}") from error

    def _validate(self, value: Any) -> None:  # noqa: ANN401 - any JSON value
        if self._validator is None:
            return
        try:
            error: Any = best_match(self._validator.iter_errors(value))
        except (RecursionError, Unresolvable, re.error, ArithmeticError) as reason:
            text = f"the schema cannot be evaluated: {type(reason).__name__}"
            raise DecodeError(text, rule="json-schema") from None
        if error is not None:
            reason = f"{error.json_path}: {error.message}"
            short_reason = reason if len(reason) <= _MAX_REASON else f"{reason[:_MAX_REASON]}…"
            raise DecodeError(f"{short_reason} ({error.validator})", rule="json-schema")


def columns_of(definition: Definition) -> JsonType:
    """Return the type of the columns of a definition."""
    kind = json_type(definition.text, definition.root) if definition.text.strip() else ANY
    return kind if kind.kind == "struct" else JsonType("struct")


def infer_definition(definition: Definition, blocks: Iterable[MessageBlock]) -> Definition:
    """Return the definition with a schema that declares the fields of the given messages.

    Messages that are not JSON objects are ignored. A schema of the recording that declares no properties still applies.
    """
    united = JsonType("struct")
    for block in blocks:
        united = _unite(united, _type_of_block([block.payload(row) for row in range(len(block))]))
    columns = _final(united)
    if columns.kind != "struct":
        return replace(definition, shape=pa.struct([]))
    schema = {"$comment": "inferred from the messages", **_schema_of(columns), "type": "object"}
    if definition.text.strip():
        schema |= {"allOf": [{"$ref": _ORIGINAL}], "$defs": {"original": _moved(json.loads(definition.text))}}
    text = json.dumps(schema, ensure_ascii=False)
    return replace(definition, types=message_types(columns, definition.root), text=text, shape=columns.struct)


def _schema_of(kind: JsonType) -> dict[str, Any]:
    """Return the JSON Schema of the values of a type; every value may be null."""
    if kind.kind == "struct":
        properties = {name: _schema_of(field) for name, field in kind.fields}
        return {"type": ["object", "null"], "properties": properties}
    if kind.item is not None:
        return {"type": ["array", "null"], "items": _schema_of(kind.item)}
    return {"type": [_JSON_TYPES[kind.kind], "null"]} if kind.kind in _JSON_TYPES else {}


def _moved(schema: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Return a schema whose references stay valid in another schema."""
    if isinstance(schema, list):
        return [_moved(item) for item in cast("list[Any]", schema)]
    if not isinstance(schema, dict):
        return schema
    return {
        key: _ORIGINAL + value.removeprefix("#") if key == "$ref" else _moved(value)
        for key, value in cast("dict[str, Any]", schema).items()
        if key not in {"$schema", "$id", "id"}
    }


def _type_of_block(payloads: list[bytes]) -> JsonType:
    lines = b"\n".join(payload.replace(b"\n", b" ") for payload in payloads)
    try:
        from pyarrow.json import ReadOptions, read_json  # noqa: PLC0415 - only JSON without a schema needs it

        table = read_json(io.BytesIO(lines), ReadOptions(use_threads=False, block_size=len(lines) + 1))
    except (pa.ArrowException, ValueError):
        united = JsonType("struct")
        for payload in payloads:
            united = _unite(united, _type_of_payload(payload))
        return united
    return _type_of_arrow(pa.struct(list(table.schema)))


def _type_of_payload(payload: bytes) -> JsonType:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return JsonType("struct")
    return _type_of_value(value) if isinstance(value, dict) else JsonType("struct")


def _type_of_value(value: Any) -> JsonType:  # noqa: ANN401 - any JSON value
    if value is None:
        return _UNKNOWN
    if isinstance(value, bool):
        return JsonType("bool")
    if isinstance(value, (int, float)):
        is_int = isinstance(value, int) and value.bit_length() <= _INT64_BITS
        return JsonType("int64" if is_int else "float64")
    if isinstance(value, str):
        return JsonType("string")
    if isinstance(value, list):
        item = _UNKNOWN
        for one in cast("list[Any]", value):
            item = _unite(item, _type_of_value(one))
        return list_of(item)
    members = cast("dict[str, Any]", value)
    return JsonType("struct", tuple((name, _type_of_value(one)) for name, one in members.items()))


def _type_of_arrow(kind: Any) -> JsonType:  # noqa: ANN401 - an Arrow type
    """Return the type of a column that pyarrow inferred. Texts that look like times are texts."""
    if pa.types.is_struct(kind):
        return JsonType("struct", tuple((field.name, _type_of_arrow(field.type)) for field in kind))
    if pa.types.is_list(kind):
        return list_of(_type_of_arrow(kind.value_type))
    if pa.types.is_null(kind):
        return _UNKNOWN
    if pa.types.is_boolean(kind):
        return JsonType("bool")
    if pa.types.is_integer(kind):
        return JsonType("int64")
    return JsonType("float64" if pa.types.is_floating(kind) else "string")


def _unite(first: JsonType, second: JsonType) -> JsonType:
    """Return a type for the values of both types."""
    if second in (first, _UNKNOWN):
        return first
    if first == _UNKNOWN:
        return second
    if first.kind == second.kind == "struct":
        fields = dict(first.fields)
        for name, kind in second.fields:
            fields[name] = _unite(fields[name], kind) if name in fields else kind
        return JsonType("struct", tuple(fields.items())) if len(fields) <= _MAX_FIELDS else ANY
    if first.item is not None and second.item is not None:
        return list_of(_unite(first.item, second.item))
    if {first.kind, second.kind} == {"int64", "float64"}:
        return JsonType("float64")
    return ANY


def _final(kind: JsonType) -> JsonType:
    """Return the type with JSON text for values that are always null, and for objects that are always empty."""
    if kind.kind == "struct":
        return struct_of({name: _final(field) for name, field in kind.fields})
    if kind.item is not None:
        return list_of(_final(kind.item))
    return ANY if kind == _UNKNOWN else kind
