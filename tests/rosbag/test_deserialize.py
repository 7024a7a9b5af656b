"""Deserialization of single messages: decoded values and refused payloads."""

from __future__ import annotations

import math
import struct
from functools import cache
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore
from rosbags.typesys.store import Typestore

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Embedded,
    Field,
    Source,
)
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Deserializer, Serializer, min_size

LITTLE = b"\x00\x01\x00\x00"
BIG = b"\x00\x00\x00\x00"
DISTROS = {Encoding.CDR: Stores.ROS2_HUMBLE, Encoding.ROS1: Stores.ROS1_NOETIC}


def definition(text: str, version: int = 2) -> Definition:
    return TypeResolver().resolve("mine/msg/X", Embedded("msg", text), ros_version=version)


def cdr(text: str, body: bytes, header: bytes = LITTLE) -> dict[str, Any]:
    return Deserializer(definition(text), Encoding.CDR).to_dict(header + body)


def ros1(text: str, body: bytes) -> dict[str, Any]:
    return Deserializer(definition(text, 1), Encoding.ROS1).to_dict(body)


def refused(text: str, payload: bytes, encoding: Encoding = Encoding.CDR) -> DecodeError:
    version = 2 if encoding is Encoding.CDR else 1
    with pytest.raises(DecodeError) as caught:
        Deserializer(definition(text, version), encoding).to_dict(payload)
    return caught.value


class TestValues:
    def test_cdr_fields_are_aligned_relative_to_header_end(self) -> None:
        body = struct.pack("<b7xdb3xi", 1, 2.5, 3, 4)
        assert cdr("int8 a\nfloat64 b\nint8 c\nint32 d", body) == {"a": 1, "b": 2.5, "c": 3, "d": 4}

    def test_ros1_fields_are_packed(self) -> None:
        assert ros1("int8 a\nfloat64 b", struct.pack("<bd", 1, 2.5)) == {"a": 1, "b": 2.5}

    def test_cdr_big_endian_is_decoded(self) -> None:
        assert cdr("int32 a\nuint16[] b", struct.pack(">iI2H", 1, 2, 3, 4), BIG) == {"a": 1, "b": [3, 4]}

    def test_byte_sequence_is_bytes_and_fixed_array_is_list(self) -> None:
        body = struct.pack("<I3s2B", 3, b"abc", 1, 2)
        assert cdr("uint8[] a\nuint8[2] b", body) == {"a": b"abc", "b": [1, 2]}

    def test_cdr_empty_sequence_is_not_aligned(self) -> None:
        assert cdr("float64[] a\nint32 b", struct.pack("<Ii", 0, 7)) == {"a": [], "b": 7}

    def test_bool_nonzero_byte_is_true(self) -> None:
        assert cdr("bool a\nbool[2] b", b"\x02\x00\xff") == {"a": True, "b": [False, True]}

    def test_field_named_like_keyword_keeps_its_name(self) -> None:
        assert cdr("int8 from\nint8 class", b"\1\2") == {"from": 1, "class": 2}

    def test_wstring_is_decoded_from_32_bit_units(self) -> None:
        units = struct.pack("<I4I", 4, ord("é"), 0xD83D, 0xDE00, ord("a"))
        assert cdr("wstring w", units) == {"w": "é😀a"}

    def test_string_of_size_zero_is_empty(self) -> None:
        assert cdr("string s", struct.pack("<I", 0)) == {"s": ""}

    @pytest.mark.parametrize("body", [b"", b"\0", b"\0\0\0\0"])
    def test_message_without_fields_is_empty_dict(self, body: bytes) -> None:
        assert cdr("# nothing", body) == {}

    def test_cdr_nested_empty_message_takes_one_byte(self) -> None:
        text = "E e\nint8 a\n" + "=" * 80 + "\nMSG: mine/E\n"
        assert cdr(text, b"\0\5") == {"e": {}, "a": 5}
        assert ros1(text, b"\5") == {"e": {}, "a": 5}


class TestTails:
    @pytest.mark.parametrize("tail", [b"", b"\1", b"\1\2", b"\1\2\3"])
    def test_cdr_three_trailing_bytes_are_accepted(self, tail: bytes) -> None:
        assert cdr("int8 a", b"\5" + tail) == {"a": 5}

    @pytest.mark.parametrize("source", list(Source))
    def test_deserializer_trailing_bytes_are_refused_for_every_source(self, source: Source) -> None:
        reader = Deserializer(replace(definition("int8 a"), source=source), Encoding.CDR)
        with pytest.raises(DecodeError) as raised:
            reader.to_dict(LITTLE + bytes(8) + b"\1")
        assert raised.value.rule == "trailing-bytes"

    @pytest.mark.promise("trailing-bytes")
    def test_cdr_four_to_seven_trailing_zeros_are_counted(self) -> None:
        reader = Deserializer(definition("int32 a"), Encoding.CDR)
        assert reader.to_dict(LITTLE + struct.pack("<i", 5) + bytes(7)) == {"a": 5}
        assert reader.padded == 1

    @pytest.mark.parametrize("tail", [b"\0\0\0\1", bytes(8)])
    def test_cdr_more_trailing_bytes_raise(self, tail: bytes) -> None:
        error = refused("int32 a", LITTLE + bytes(4) + tail)
        assert error.rule == "trailing-bytes"
        assert f"{len(tail)} bytes remain" in str(error)

    def test_ros1_trailing_bytes_raise(self) -> None:
        assert refused("int8 a", b"\0\0", Encoding.ROS1).rule == "trailing-bytes"


class TestRefusals:
    @pytest.mark.parametrize(
        ("payload", "rule"),
        [
            (b"", "encapsulation"),
            (b"\0\1\0", "encapsulation"),
            (b"\x28\xb5\x2f\xfd\0\0", "encapsulation"),
            (b"\0\3\0\0\0", "pl-cdr"),
            (b"\0\7\0\0\0", "xcdr2"),
            (b"\0\x0b\0\0\0", "xcdr2"),
        ],
    )
    def test_cdr_unsupported_encapsulation_raises(self, payload: bytes, rule: str) -> None:
        assert refused("int8 a", payload).rule == rule

    @pytest.mark.parametrize(
        ("text", "body", "rule"),
        [
            ("int32 a", bytes(3), "truncated"),
            ("int8 a\nfloat64 b", bytes(8), "truncated"),
            ("float32[4] a", bytes(15), "truncated"),
            ("string s", struct.pack("<I", 9) + b"abc\0", "string-length"),
            ("string s", struct.pack("<I", 3) + b"abc", "string-terminator"),
            ("string s", struct.pack("<I", 3) + b"\xff\xfe\0", "utf8"),
            ("wstring s", struct.pack("<II", 1, 0xD800), "utf16"),
            ("wstring s", struct.pack("<II", 1, 0xFFFFFFFF), "utf16"),
            ("wstring s", struct.pack("<II", 0x40000000, 1), "string-length"),
            ("float64[] a", struct.pack("<I", 0xFFFFFFFF), "sequence-length"),
            ("string[] a", struct.pack("<I", 0xFFFFFFFF), "sequence-length"),
            ("geometry_msgs/Point[] a", struct.pack("<I", 0xFFFFFFFF) + bytes(100), "sequence-length"),
            ("int8[<=2] a", struct.pack("<I3b", 3, 1, 2, 3), "sequence-bound"),
        ],
    )
    def test_length_beyond_payload_raises(self, text: str, body: bytes, rule: str) -> None:
        assert refused(text, LITTLE + body).rule == rule

    def test_ros1_empty_elements_are_limited(self) -> None:
        text = "E[] e\n" + "=" * 80 + "\nMSG: mine/E\n"
        assert refused(text, struct.pack("<I", 0xFFFFFFFF), Encoding.ROS1).rule == "sequence-length"
        assert ros1(text, struct.pack("<I", 3)) == {"e": [{}, {}, {}]}

    def test_error_names_the_path_of_the_field(self) -> None:
        error = refused("std_msgs/Header header", LITTLE + struct.pack("<iII", 0, 0, 99))
        assert str(error).startswith("header.frame_id: a string of 99 bytes")

    def test_error_suggests_distro_whose_definition_matches(self) -> None:
        header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "f"}
        values = {"header": header, "radiation_type": 0} | dict.fromkeys(
            ("field_of_view", "min_range", "max_range", "range", "variance"), 1.5
        )
        humble, jazzy = (
            TypeResolver(distro).resolve("sensor_msgs/msg/Range", None, ros_version=2)
            for distro in ("ros2_humble", "ros2_jazzy")
        )
        with pytest.raises(DecodeError, match="use the definition of ros2_lyrical"):
            Deserializer(humble, Encoding.CDR).to_dict(Serializer(jazzy, Encoding.CDR).from_dict(values))
        with pytest.raises(DecodeError, match="use the definition of ros2_humble"):
            Deserializer(jazzy, Encoding.CDR).to_dict(Serializer(humble, Encoding.CDR).from_dict(values))

    def test_serialize_invalid_value_raises(self) -> None:
        writer = Serializer(definition("uint8 a\nint8[2] b"), Encoding.CDR)
        for values in ({"a": 256, "b": [1, 2]}, {"a": 1}, {"a": 1, "b": [1]}, {"a": "x", "b": [1, 2]}):
            with pytest.raises(BagError, match="do not match mine/msg/X"):
                writer.from_dict(values)

    def test_deserializer_other_encoding_raises(self) -> None:
        with pytest.raises(BagError):
            Deserializer(definition("int8 a"), Encoding.OTHER)


@cache
def standard(encoding: Encoding) -> tuple[Typestore, dict[str, Definition]]:
    distro = DISTROS[encoding]
    store = get_typestore(RosbagsStores(distro.value))
    resolver, version = TypeResolver(distro), 1 if encoding is Encoding.ROS1 else 2
    return store, {name: resolver.resolve(name, None, ros_version=version) for name in store.fielddefs}


INTEGERS = {f"{sign}int{bits}": (0 if sign else -(2 ** (bits - 1)), 2 ** (bits - (not sign)) - 1)
            for bits in (8, 16, 32, 64) for sign in ("", "u")}  # fmt: skip
PLAIN: dict[str, st.SearchStrategy[Any]] = {
    "bool": st.booleans(),
    "byte": st.integers(0, 127),  # rosbags reads a byte as signed
    "char": st.integers(0, 255),
    "float32": st.floats(width=32, allow_nan=False),
    "float64": st.floats(allow_nan=False),
    "string": st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12),
    "wstring": st.text(st.characters(codec="utf-8"), max_size=12),
    **{name: st.integers(*bounds) for name, bounds in INTEGERS.items()},
}


def values_of(known: Definition, field: Field) -> st.SearchStrategy[Any]:
    element = messages_of(known, field.type) if field.is_message else PLAIN[field.type]
    if field.container is Container.SCALAR:
        return element
    if field.container is Container.ARRAY:
        return st.lists(element, min_size=field.size, max_size=field.size)
    several = st.lists(element, max_size=min(field.size or 4, 4))
    return several.map(bytes) if field.type in {"byte", "char", "uint8"} else several


def messages_of(known: Definition, name: str) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({field.name: values_of(known, field) for field in known.types[name].fields})


def plain(value: Any, field: Field, known: Definition) -> Any:
    """Convert objects and arrays of rosbags to the values of our deserializer."""
    if field.container is not Container.SCALAR:
        if field.type in {"byte", "char", "uint8"} and field.container is Container.SEQUENCE:
            return bytes(value)
        one = Field(field.name, field.type, field.is_message)
        return [plain(element, one, known) for element in value]
    if field.is_message:
        return unpacked(value, field.type, known)
    return value.item() if hasattr(value, "item") else value


def unpacked(message: Any, name: str, known: Definition) -> dict[str, Any]:
    fields = known.types[name].fields
    return {field.name: plain(getattr(message, field.name), field, known) for field in fields}


@pytest.mark.parametrize("encoding", list(DISTROS))
@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_serializer_output_is_decoded_equally_by_rosbags(encoding: Encoding, data: st.DataObject) -> None:
    store, definitions = standard(encoding)
    name = data.draw(st.sampled_from(sorted(definitions)))
    known = definitions[name]
    assume(
        sum(f.size for t in known.types.values() for f in t.fields if f.container is Container.ARRAY) < 200
    )
    values = data.draw(messages_of(known, name))
    payload = Serializer(known, encoding).from_dict(values)
    reader = Deserializer(known, encoding)
    assert reader.to_dict(payload) == values
    assert len(payload) >= min_size(name, known.types, cdr=encoding is Encoding.CDR)
    if encoding is Encoding.CDR:
        assert reader.to_dict(Serializer(known, encoding, big_endian=True).from_dict(values)) == values
        judged = store.deserialize_cdr(payload, name)
    else:
        judged = store.deserialize_ros1(payload, name)
    assert unpacked(judged, name, known) == values


@st.composite
def own_definitions(draw: st.DrawFn) -> str:
    """The definition of a type with every kind of field, and of its nested type."""
    kinds = st.sampled_from([*PLAIN, "time", "string<=20", "Inner", "Empty"])
    brackets = st.sampled_from(["", "", "", "[]", "[3]", "[<=4]"])

    def fields(kinds: st.SearchStrategy[str], least: int) -> str:
        lines = draw(st.lists(st.tuples(kinds, brackets), min_size=least, max_size=5))
        return "".join(f"{kind}{size} field_{number}\n" for number, (kind, size) in enumerate(lines))

    bar = "=" * 80
    inner = fields(st.sampled_from([*PLAIN, "Empty"]), 1)
    return f"{fields(kinds, 0)}{bar}\nMSG: mine/Inner\n{inner}{bar}\nMSG: mine/Empty\n"


@pytest.mark.parametrize("encoding", list(DISTROS))
@settings(deadline=None, max_examples=60)
@given(text=own_definitions(), data=st.data())
def test_serializer_any_type_round_trips(encoding: Encoding, text: str, data: st.DataObject) -> None:
    known = definition(text, 1 if encoding is Encoding.ROS1 else 2)
    assert definition(known.text, known.ros_version).types == known.types
    values = data.draw(messages_of(known, known.root))
    payload = Serializer(known, encoding).from_dict(values)
    assert Deserializer(known, encoding).to_dict(payload) == values
    if payload:
        cut = data.draw(st.integers(0, len(payload) - 1))
        damaged = payload[:cut] + data.draw(st.binary(max_size=6)) + payload[cut + 1 :]
        Deserializer(known, encoding).fits(damaged)


def test_serializer_nan_round_trips() -> None:
    payload = Serializer(definition("float64 a"), Encoding.CDR).from_dict({"a": math.nan})
    assert math.isnan(cdr("float64 a", payload[4:])["a"])


@pytest.mark.parametrize("encoding", list(DISTROS))
@settings(deadline=None, max_examples=150)
@given(data=st.data())
def test_deserialize_any_bytes_returns_or_raises_decode_error(
    encoding: Encoding, data: st.DataObject
) -> None:
    _, definitions = standard(encoding)
    known = definitions[data.draw(st.sampled_from(sorted(definitions)))]
    body = data.draw(st.binary(max_size=300) | st.just(b"\xff" * 64))
    payload = data.draw(st.sampled_from([LITTLE, BIG, b""])) + body
    rules = set[str]()
    try:
        Deserializer(known, encoding).to_dict(payload)
    except DecodeError as error:
        rules.add(error.rule)
    assert "decode" not in rules
