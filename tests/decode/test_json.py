"""Tests of the columnar JSON decoder against jsonschema and Python's parser."""

from __future__ import annotations

import base64
import json
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from mosaico_ingest.decode.decoder import Decoded, DictDecoder
from mosaico_ingest.decode.json import JsonDecoder
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.encodings.json_messages import JsonCodec, infer_definition
from mosaico_ingest.rosbag.encodings.json_schema import confirming_type, read_schema, validator_of

KIND = {"title": "KIND", "type": "integer", "oneOf": [{"title": "A", "const": 0}, {"title": "B", "const": 1}]}
SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["id"],
    "properties": {
        "id": {"type": "integer", "minimum": 0, "maximum": 9},
        "x": {"type": "number", "exclusiveMinimum": -5},
        "name": {"type": ["string", "null"], "maxLength": 3},
        "flag": {"type": "boolean"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "kind": KIND,
        "level": {"enum": ["low", "high"]},
        "points": {"type": "array", "maxItems": 2, "items": {"$ref": "#/$defs/point"}},
        "grid": {"type": "array", "items": {"type": "array", "items": {"type": "number"}}},
        "best": {"anyOf": [{"$ref": "#/$defs/point"}, {"type": "null"}]},
    },
    "$defs": {
        "point": {
            "title": "Point",
            "type": "object",
            "properties": {"x": {"type": "number"}, "y": {"type": "number"}},
            "additionalProperties": False,
        }
    },
}


def definition_of(schema: Any, name: str = "T") -> Definition:
    return read_schema(name, Embedded("jsonschema", json.dumps(schema)))


DEFINITION = definition_of(SCHEMA)


def block_of(payloads: list[bytes]) -> MessageBlock:
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    zeros = np.zeros(len(payloads), np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return MessageBlock(0, zeros, data, np.cumsum(lengths) - lengths, lengths, zeros)


@lru_cache(maxsize=64)
def decoders(name: str, text: str) -> tuple[JsonDecoder, DictDecoder]:
    definition = read_schema(name, Embedded("jsonschema", text))
    definition = definition if definition.shape is not None else replace(definition, shape=pa.struct([]))
    return JsonDecoder(definition), DictDecoder(definition.shape or pa.struct([]), JsonCodec(definition))


def check_agreement(definition: Definition, payloads: list[bytes]) -> Decoded:
    fast, slow = (
        decoder.decode(block_of(payloads)) for decoder in decoders(definition.root, definition.text)
    )
    fast.rows.validate(full=True)
    assert fast.rows.type == slow.rows.type
    assert fast.index.tolist() == slow.index.tolist()
    assert fast.failures == slow.failures
    assert repr(fast.rows.to_pylist()) == repr(slow.rows.to_pylist())
    return fast


POINT = st.fixed_dictionaries({}, optional={"x": st.floats(-10, 10), "y": st.integers(-9, 9)})
VALID: dict[str, st.SearchStrategy[Any]] = {
    "x": st.floats(-4, 1e9) | st.integers(-4, 10),
    "name": st.none() | st.text(st.characters(exclude_categories=["Cs"]), max_size=3),
    "flag": st.booleans(),
    "data": st.binary(max_size=4).map(lambda data: base64.b64encode(data).decode()),
    "kind": st.sampled_from([0, 1]),
    "level": st.sampled_from(["low", "high"]),
    "points": st.lists(POINT, max_size=2),
    "grid": st.lists(st.lists(st.floats(-1, 1), max_size=2), max_size=2),
    "best": st.none() | POINT,
}
OBJECT = st.fixed_dictionaries({"id": st.integers(0, 9)}, optional=VALID)
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from("xy"), inner, max_size=2),
    max_leaves=3,
)
WRONG = st.dictionaries(st.sampled_from([*SCHEMA["properties"], "extra"]), ANYTHING, max_size=4)


def _text(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode("utf-8", "surrogatepass")


@given(st.lists(OBJECT, min_size=5, max_size=8))
def test_decoder_valid_messages_equal_jsonschema(values: list[Any]) -> None:
    decoded = check_agreement(DEFINITION, [_text(value) for value in values])
    assert len(decoded.index) == len(values)


@example([{"id": 0}] * 5 + [{"id": 0, "extra": [None, None]}])  # pyarrow builds an invalid array of nulls
@given(
    st.lists(OBJECT | WRONG | OBJECT.flatmap(lambda good: WRONG.map(lambda bad: {**good, **bad})), min_size=5)
)
def test_decoder_any_messages_equal_jsonschema(values: list[Any]) -> None:
    check_agreement(DEFINITION, [_text(value) for value in values])


@given(st.lists(st.binary(max_size=8) | OBJECT.map(_text), min_size=5, max_size=8), st.integers(0, 40))
def test_decoder_damaged_messages_equal_jsonschema(payloads: list[bytes], cut: int) -> None:
    check_agreement(DEFINITION, [payloads[0][:cut], *payloads[1:]])


KEYWORDS: tuple[dict[str, Any] | bool, ...] = (
    {"type": "integer", "minimum": 2},
    {"type": "number", "maximum": 1.5},
    {"type": ["integer", "null"]},
    {"type": ["string", "number"]},
    {"type": "string", "minLength": 2},
    {"type": "string", "pattern": "^a"},
    {"type": "array", "items": {"type": "integer"}, "minItems": 1},
    {"type": "array"},
    {"type": "object"},
    {"type": "object", "additionalProperties": {"type": "integer"}},
    {"type": "object", "properties": {"x": {"type": "integer"}}, "required": ["x"]},
    {"type": "object", "properties": {"x": {"type": "integer"}}, "additionalProperties": False},
    {"properties": {"x": {"type": "integer"}}},
    {"enum": ["a", 1]},
    {"enum": [1, 2]},
    {"const": "aa"},
    {"oneOf": [{"const": 1}, {"const": 2}]},
    {"oneOf": [{"type": "integer"}, {"type": "number"}]},
    {"anyOf": [{"type": "string"}, {"type": "null"}]},
    {"allOf": [{"type": "integer"}, {"minimum": 1}]},
    {"not": {"type": "string"}},
    {"type": "integer", "multipleOf": 2},
    {"type": "array", "uniqueItems": True},
    {"type": "array", "prefixItems": [{"type": "integer"}]},
    {"if": {"type": "integer"}, "then": {"minimum": 1}},
    {"$ref": "#/$defs/small"},
    {"$ref": "#"},
    {},
    True,
    False,
)


DRAFTS = {
    "2020-12": "https://json-schema.org/draft/2020-12/schema",
    "7": "http://json-schema.org/draft-07/schema#",
    "4": "http://json-schema.org/draft-04/schema#",
}


@pytest.mark.parametrize(
    "draft", ["2020-12", *(pytest.param(name, marks=pytest.mark.slow) for name in ("7", "4"))]
)
@settings(max_examples=150)
@given(data=st.data())
def test_decoder_keyword_in_any_draft_equals_jsonschema(data: st.DataObject, draft: str) -> None:
    keyword = data.draw(
        st.sampled_from([one for one in KEYWORDS if draft != "4" or not isinstance(one, bool)])
    )
    values = data.draw(st.lists(ANYTHING, min_size=5, max_size=8))
    schema = {
        "$schema": DRAFTS[draft],
        "type": "object",
        "properties": {"v": keyword},
        "$defs": {"small": {"type": "integer", "maximum": 3}},
    }
    check_agreement(definition_of(schema), [_text({"v": value}) for value in values])


def test_confirming_type_exists_for_common_schemas() -> None:
    assert confirming_type(json.dumps(SCHEMA), "T") is not None
    assert confirming_type('{"type": "object", "properties": {"a": {"not": {}}}}', "T") is None


def test_decoder_invalid_message_reason_has_path_and_keyword() -> None:
    payloads = [b'{"id": 1}'] * 6 + [b'{"id": 1, "points": [{"x": "far"}]}', b"{", b"[1]"]
    failures = JsonDecoder(DEFINITION).decode(block_of(payloads)).failures
    assert [(failure.row, failure.rule) for failure in failures] == [
        (6, "json-schema"),
        (7, "json-syntax"),
        (8, "json-syntax"),
    ]
    assert failures[0].reason == "$.points[0].x: 'far' is not of type 'number' (type)"


def test_decoder_undeclared_fields_are_reported() -> None:
    payloads = [b'{"id": 1}'] * 6 + [b'{"id": 1, "speed": 3, "x": 1}']
    assert JsonDecoder(DEFINITION).decode(block_of(payloads)).undeclared == {"speed"}
    assert JsonDecoder(DEFINITION).decode(block_of(payloads[5:])).undeclared == {"speed"}


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b'{"id": 1, "data": "!!"}', "not base64"),
        (b'{"id": 1, "name": "\\ud800"}', "surrogate"),
        (b'{"big": 9223372036854775808}', "does not fit int64"),
    ],
)
def test_decoder_value_that_fits_no_column_is_rejected(payload: bytes, reason: str) -> None:
    schema = {**SCHEMA, "required": [], "properties": {**SCHEMA["properties"], "big": {"type": "integer"}}}
    decoded = check_agreement(definition_of(schema), [payload, *[b'{"id": 1}'] * 6])
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(0, "json-value")]
    assert reason in decoded.failures[0].reason


def test_decoder_messages_with_line_breaks_and_repeated_keys_are_decoded() -> None:
    payloads = [b'{\n  "id": 1\n}', b'{"id": 1, "id": 2}', *[b'{"id": 3}'] * 5, b'{"id": 4}{"id": 5}']
    decoded = check_agreement(DEFINITION, payloads)
    assert decoded.rows.field("id").to_pylist() == [1, 2, 3, 3, 3, 3, 3]


def test_definition_has_titles_and_constants_of_the_schema() -> None:
    fields = {field.name: field for field in DEFINITION.message.fields}
    assert (fields["points"].type, fields["points"].is_message, fields["best"].type) == (
        "Point",
        True,
        "Point",
    )
    assert [(one.name, one.value) for one in DEFINITION.message.constants] == [("A", 0), ("B", 1)]


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("{", "not JSON"),
        ('{"type": 3}', "not a JSON Schema"),
        ('{"$ref": "https://example.org/a"}', "another document"),
        ('{"$ref": "#/$defs/a"}', "does not contain"),
    ],
)
def test_read_schema_unusable_schema_raises(text: str, part: str) -> None:
    with pytest.raises(BagError, match=part):
        read_schema("T", Embedded("jsonschema", text))


@example([{}] * 5)  # pyarrow's tables without columns have no rows
@given(st.lists(WRONG, min_size=1, max_size=12))
def test_inferred_definition_accepts_every_object(values: list[Any]) -> None:
    payloads = [_text(value) for value in values]
    definition = infer_definition(read_schema("", None), [block_of(payloads)])
    decoded = check_agreement(definition, payloads)
    surrogates = any("\\ud" in json.dumps(value) for value in values)
    assert surrogates or len(decoded.index) == len(values)
    assert not decoded.undeclared


def test_inferred_definition_unites_the_types_of_all_messages() -> None:
    blocks = [
        block_of([b'{"a": 1, "o": {"x": 1}}', b'{"a": null}']),
        block_of([b'{"a": 2.5, "o": {"y": "z"}, "m": 1}', b'{"m": "text", "l": []}', b"broken"]),
    ]
    definition = infer_definition(read_schema("", None), blocks)
    types = {field.name: field.type for field in definition.message.fields}
    assert types == {"a": "float64", "o": "json.o", "m": "json", "l": "json"}
    assert definition.root == "json"


def test_inferred_definition_keeps_the_schema_of_the_recording() -> None:
    schema = {
        "type": "object",
        "additionalProperties": {"$ref": "#/$defs/n"},
        "$defs": {"n": {"type": "number"}},
    }
    payloads = [b'{"a": 1}', b'{"b": 2.5}', b'{"a": "text"}']
    definition = infer_definition(definition_of(schema), [block_of(payloads)])
    decoded = check_agreement(definition, payloads)
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(2, "json-schema")]


@given(OBJECT)
def test_codec_restores_equal_message(value: Any) -> None:
    codec = JsonCodec(DEFINITION)
    row = codec.to_dict(_text(value))
    assert codec.to_dict(codec.from_dict(row)) == row


def test_validator_never_downloads_schemas() -> None:
    assert validator_of(
        '{"$schema": "http://json-schema.org/draft-07/schema#", "type": "object"}', "T"
    ).is_valid({})


@pytest.mark.parametrize(
    "schema",
    [
        {"$ref": "#"},
        {"properties": {"a": {"$ref": "#/properties/a"}}},
        {"$dynamicRef": "#missing", "properties": {"a": {"type": "integer"}}},
        {"properties": {"a": {"pattern": "("}}},
        {"type": "object", "properties": {"": {"type": "integer"}, "a b": {"minimum": 10**30}}},
    ],
    ids=json.dumps,
)
def test_hostile_schema_rejects_rows_or_raises_own_error(schema: Any) -> None:
    payloads = [b'{"a": 1}', b'{"": 2, "a b": 3}', b"{}", b'{"a": "x"}', b"[]"]
    try:
        definition = definition_of(schema)
    except BagError:
        return
    definition = (
        definition if definition.shape is not None else infer_definition(definition, [block_of(payloads)])
    )
    decoded = check_agreement(definition, payloads)
    assert len(decoded.index) + len(decoded.failures) == len(payloads)
