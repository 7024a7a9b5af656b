"""Tests of the columnar protobuf decoder against Google's parser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from protobuf_schemas import (
    SCALARS,
    definition_of,
    editions_file,
    file_set,
    message_class,
    proto2_file,
    proto3_file,
)

from mosaico_ingest.decode.decoder import Decoded, DictDecoder
from mosaico_ingest.decode.protobuf import ProtobufDecoder
from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.blocks import MessageBlock
from mosaico_ingest.rosbag.definitions.model import Embedded
from mosaico_ingest.rosbag.encodings.protobuf import ProtobufCodec, read_schema

FILE3, FILE2, FILE_GROUP = proto3_file(), proto2_file(), proto2_file(group=True)
MESSAGE = definition_of(FILE3, "all.Message")
OLD = definition_of(FILE2, "all.Old")
GROUPED = definition_of(FILE_GROUP, "all.Old")
Message = message_class(FILE3, "all.Message")
Old = message_class(FILE2, "all.Old")
Grouped = message_class(FILE_GROUP, "all.Old")

INT = {32: st.integers(-(2**31), 2**31 - 1), 64: st.integers(-(2**63), 2**63 - 1)}
UINT = {32: st.integers(0, 2**32 - 1), 64: st.integers(0, 2**64 - 1)}
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=5)


def _values(name: str) -> st.SearchStrategy[Any]:
    if name in {"double", "float"}:
        return st.floats(width=32 if name == "float" else 64, allow_nan=False)
    if name in {"bool", "string", "bytes"}:
        return {"bool": st.booleans(), "string": TEXT, "bytes": st.binary(max_size=5)}[name]
    return (UINT if name.startswith(("uint", "fixed")) else INT)[int(name[-2:])]


INNER = st.fixed_dictionaries({}, optional={"x": st.floats(allow_nan=False), "label": TEXT})
TREE = st.recursive(
    st.fixed_dictionaries({}, optional={"value": INT[32]}),
    lambda children: st.fixed_dictionaries({"children": st.lists(children, max_size=2)}),
    max_leaves=3,
)
COLOR = st.integers(-1, 4)
FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "last": INT[32],
    **{f"{form}_{name}": _values(name) for name in SCALARS for form in ("one", "maybe")},
    **{f"many_{name}": st.lists(_values(name), max_size=3) for name in SCALARS},
    "one_color": COLOR,
    "maybe_color": COLOR,
    "many_color": st.lists(COLOR, max_size=3),
    "inner": INNER,
    "inners": st.lists(INNER, max_size=3),
    "stamp": st.fixed_dictionaries({"seconds": INT[64], "nanos": INT[32]}),
    "wrapped": st.fixed_dictionaries({}, optional={"value": st.floats(allow_nan=False)}),
    "wrapped_texts": st.lists(st.fixed_dictionaries({"value": TEXT}), max_size=2),
    "free": st.just({"fields": {}}),
    "tree": TREE,
    "nothing": st.just({}),
    "unpacked": st.lists(INT[32], max_size=3),
    "numbers": st.dictionaries(TEXT, INT[32], max_size=1),
    "messages": st.dictionaries(INT[32], INNER, max_size=1),
}
CHOICES = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"text_choice": TEXT}),
    st.fixed_dictionaries({"int_choice": INT[32]}),
    st.fixed_dictionaries({"inner_choice": INNER}),
)


@st.composite
def messages(draw: st.DrawFn) -> bytes:
    names = draw(st.lists(st.sampled_from(sorted(FIELDS)), max_size=8, unique=True))
    return Message(**{name: draw(FIELDS[name]) for name in names}, **draw(CHOICES)).SerializeToString()


@st.composite
def damaged(draw: st.DrawFn, source: st.SearchStrategy[bytes]) -> bytes:
    """Return a message after a few changed, removed or appended bytes, or two merged messages."""
    data = bytearray(draw(source))
    match draw(st.sampled_from(["change", "cut", "append", "merge"])):
        case "change" if data:
            data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
        case "cut":
            del data[draw(st.integers(0, len(data))) :]
        case "append":
            data += draw(st.binary(max_size=4))
        case _:
            data += draw(source)
    return bytes(data)


def block_of(payloads: list[bytes]) -> MessageBlock:
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    starts = np.cumsum(lengths) - lengths
    zeros = np.zeros(len(payloads), np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return MessageBlock(0, zeros, data, starts, lengths, zeros)


def check_same(fast: Decoded, slow: Decoded) -> None:
    fast.rows.validate(full=True)
    assert fast.rows.type == slow.rows.type
    assert fast.index.tolist() == slow.index.tolist()
    assert fast.failures == slow.failures
    assert repr(_sorted_maps(fast.rows.to_pylist())) == repr(_sorted_maps(slow.rows.to_pylist()))


def _sorted_maps(rows: Any) -> Any:
    for row in rows:
        for name in ("numbers", "messages"):
            if name in row:
                row[name].sort(key=lambda entry: entry["key"])
    return rows


@given(st.lists(messages(), min_size=5, max_size=8))
def test_decoder_valid_messages_equal_googles_parser(payloads: list[bytes]) -> None:
    slow = DictDecoder(MESSAGE.shape, ProtobufCodec(MESSAGE)).decode(block_of(payloads))
    check_same(ProtobufDecoder(MESSAGE).decode(block_of(payloads)), slow)
    assert len(slow.index) == len(payloads)


@given(st.lists(st.one_of(messages(), damaged(messages()), st.binary(max_size=20)), min_size=5, max_size=8))
def test_decoder_damaged_messages_equal_googles_parser(payloads: list[bytes]) -> None:
    slow = DictDecoder(MESSAGE.shape, ProtobufCodec(MESSAGE)).decode(block_of(payloads))
    check_same(ProtobufDecoder(MESSAGE).decode(block_of(payloads)), slow)


LEVEL = st.sampled_from([3, 7])
OLD_FIELDS = st.fixed_dictionaries(
    {},
    optional={
        "needed": INT[32],
        "text": TEXT,
        "level": LEVEL,
        "levels": st.lists(LEVEL, max_size=3),
        "values": st.lists(st.floats(allow_nan=False), max_size=3),
    },
)


@pytest.mark.parametrize(("definition", "kind"), [(OLD, Old), (GROUPED, Grouped)], ids=["proto2", "group"])
@given(data=st.data())
def test_decoder_proto2_messages_equal_googles_parser(
    data: st.DataObject, definition: Any, kind: Any
) -> None:
    source = OLD_FIELDS.map(lambda values: kind(**values).SerializePartialToString())
    payloads = data.draw(st.lists(st.one_of(source, damaged(source)), min_size=5, max_size=8))
    slow = DictDecoder(definition.shape, ProtobufCodec(definition)).decode(block_of(payloads))
    check_same(ProtobufDecoder(definition).decode(block_of(payloads)), slow)


NEW_FIELDS = st.fixed_dictionaries(
    {},
    optional={
        **dict.fromkeys(("explicit", "implicit", "required"), INT[32]),
        "unverified": TEXT,
        **{name: st.lists(INT[32], max_size=3) for name in ("expanded", "packed")},
        "open": st.integers(-1, 4),
        "closed": st.integers(0, 1),
        "closed_list": st.lists(st.integers(0, 1), max_size=3),
        "inner": st.fixed_dictionaries({}, optional={"x": st.floats(allow_nan=False)}),
    },
)


@pytest.mark.parametrize("delimited", [False, True])
@given(data=st.data())
def test_decoder_messages_of_editions_equal_googles_parser(data: st.DataObject, *, delimited: bool) -> None:
    file = editions_file(delimited=delimited)
    definition, kind = definition_of(file, "all.New"), message_class(file, "all.New")
    source = NEW_FIELDS.map(lambda values: kind(**values).SerializePartialToString())
    payloads = data.draw(st.lists(st.one_of(source, damaged(source)), min_size=5, max_size=8))
    slow = DictDecoder(definition.shape, ProtobufCodec(definition)).decode(block_of(payloads))
    check_same(ProtobufDecoder(definition).decode(block_of(payloads)), slow)


def test_decoder_features_of_editions_decide_about_presence_text_and_enums() -> None:
    definition = definition_of(editions_file(), "all.New")
    # Field 3 is required, 4 an unverified string, 7 an open enum, and 8 a closed one.
    payload = b"\x18\x05\x22\x01a\x38\x09\x40\x09"
    row = ProtobufDecoder(definition).decode(block_of([payload] * 6)).rows[0].as_py()
    assert (row["explicit"], row["implicit"], row["required"]) == (None, 0, 5)
    assert (row["unverified"], row["open"], row["closed"]) == ("a", 9, None)
    assert [failure.rule for failure in ProtobufDecoder(definition).decode(block_of([b""] * 6)).failures] == (
        6 * ["protobuf"]
    )


def test_decoder_absent_fields_are_null_or_default() -> None:
    rows = ProtobufDecoder(MESSAGE).decode(block_of([b""] * 8)).rows.to_pylist()
    row = rows[0]
    assert (row["one_int32"], row["one_string"], row["one_color"]) == (0, "", 0)
    assert (row["maybe_int32"], row["maybe_string"], row["inner"], row["wrapped"]) == (None, None, None, None)
    assert (row["text_choice"], row["many_int32"], row["numbers"]) == (None, [], [])


def test_decoder_malformed_message_rejects_one_row() -> None:
    good = Message(one_int32=7).SerializeToString()
    decoded = ProtobufDecoder(MESSAGE).decode(block_of([good] * 9 + [b"\x0a\xff"] + [good] * 9))
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(9, "protobuf")]
    assert decoded.index.tolist() == [*range(9), *range(10, 19)]
    assert decoded.rows.field("one_int32").to_pylist() == [7] * 18


def test_decoder_proto2_message_without_required_field_is_rejected() -> None:
    payloads = [Old(needed=1).SerializeToString()] * 6 + [Old(text="x").SerializePartialToString()]
    decoded = ProtobufDecoder(OLD).decode(block_of(payloads))
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(6, "protobuf")]


def test_decoder_recursive_and_dynamic_messages_become_json_text() -> None:
    message = Message(tree={"value": 1, "children": [{"value": 2}]})
    message.free["speed"] = 1.5
    row = ProtobufDecoder(MESSAGE).decode(block_of([message.SerializeToString()] * 6)).rows[0].as_py()
    assert row["tree"] == {"value": 1, "children": ['{"value": 2}']}
    assert row["free"] == '{"speed": 1.5}'


@given(messages())
def test_codec_restores_equal_message(payload: bytes) -> None:
    codec = ProtobufCodec(MESSAGE)
    values = codec.to_dict(payload)
    assert codec.to_dict(codec.from_dict(values)) == values


def test_definition_has_types_and_constants_of_enums() -> None:
    assert [(one.name, one.value) for one in MESSAGE.message.constants] == [
        ("RED", 0),
        ("GREEN", 1),
        ("BLUE", 2),
    ]
    fields = {field.name: field for field in MESSAGE.message.fields}
    assert (fields["inner"].type, fields["inner"].is_message) == ("all.Inner", True)
    assert list(MESSAGE.types) == [
        "all.Message",
        "all.Inner",
        "google.protobuf.Timestamp",
        "all.Tree",
        "all.Empty",
        "all.Message.NumbersEntry",
        "all.Message.MessagesEntry",
    ]


@pytest.mark.parametrize(
    ("embedded", "text"),
    [
        (None, "no schema"),
        (Embedded("jsonschema", "{}"), "'jsonschema'"),
        (Embedded.from_bytes("protobuf", b"\xff"), "FileDescriptorSet"),
        (Embedded.from_bytes("protobuf", b""), "does not define all.Message"),
    ],
)
def test_read_schema_unusable_schema_raises(embedded: Embedded | None, text: str) -> None:
    with pytest.raises(BagError, match=text):
        read_schema("all.Message", embedded)


@given(st.integers(0, 400), st.integers(0, 255))
def test_read_schema_damaged_schema_raises_only_own_errors(position: int, value: int) -> None:
    data = bytearray(file_set(FILE2))
    data[position % len(data)] = value
    try:
        definition = read_schema("all.Old", Embedded.from_bytes("protobuf", bytes(data)))
    except BagError:
        return
    assert len(ProtobufDecoder(definition).decode(block_of([b"\x08\x01"] * 6)).rows) <= 6
