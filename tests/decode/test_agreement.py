"""Decoding by columns agrees with decoding row by row, for any definition, any values and any bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.decode import locate as lockstep
from mosaico_ingest.decode.decoder import Decoded
from mosaico_ingest.decode.layout import LocatedMessages, Payloads, StepOffsets, compile_layout
from mosaico_ingest.decode.locate import locate, locate_lockstep, locate_one_by_one
from mosaico_ingest.rosbag.blocks import Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.serialization import Serializer

BatchOf = Callable[[Sequence[bytes]], MessageBlock]
AssertAgree = Callable[[Sequence[bytes], Definition, Encoding], Decoded]

RELAXED = settings(deadline=None, suppress_health_check=list(HealthCheck), max_examples=120)

INTEGERS = {
    "byte": (0, 255), "char": (0, 255), "uint8": (0, 255), "int8": (-128, 127), "uint16": (0, 65535),
    "int16": (-32768, 32767), "uint32": (0, 2**32 - 1), "int32": (-(2**31), 2**31 - 1),
    "uint64": (0, 2**64 - 1), "int64": (-(2**63), 2**63 - 1),
}  # fmt: skip
PRIMITIVES = (*INTEGERS, "bool", "float32", "float64", "string", "wstring")


def make(root: str, types: dict[str, Sequence[Field]], *, ros_version: int = 2) -> Definition:
    messages = {name: MessageType(name, tuple(fields)) for name, fields in types.items()}
    return Definition(root, messages, Source.BAG, "", ros_version)


@st.composite
def definitions(draw: st.DrawFn, depth: int = 3) -> Definition:
    names = [f"test/msg/T{number}" for number in range(draw(st.integers(1, depth)))]
    types: dict[str, list[Field]] = {}
    for number, name in enumerate(names):
        inner = names[number + 1 :]
        count = draw(st.integers(0 if number else 1, 5))
        types[name] = [draw(fields(f"f{place}", inner)) for place in range(count)]
    return make(names[0], types)


@st.composite
def fields(draw: st.DrawFn, name: str, inner: Sequence[str]) -> Field:
    kind = draw(st.sampled_from((*PRIMITIVES, *inner * 4)))
    container = draw(
        st.sampled_from((Container.SCALAR, Container.SCALAR, Container.ARRAY, Container.SEQUENCE))
    )
    size = {Container.SCALAR: st.just(0), Container.ARRAY: st.integers(1, 3)}.get(
        container, st.integers(0, 4)
    )
    return Field(name, kind, kind in inner, container, draw(size))


def values_of(definition: Definition, name: str) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries(
        {field.name: value_of(definition, field) for field in definition.types[name].fields}
    )


def value_of(definition: Definition, field: Field) -> st.SearchStrategy[Any]:
    one: st.SearchStrategy[Any]
    if field.is_message:
        one = values_of(definition, field.type)
    elif field.type in INTEGERS:
        one = st.integers(*INTEGERS[field.type])
    elif field.type == "bool":
        one = st.booleans()
    elif field.type in {"string", "wstring"}:
        one = st.text(max_size=6)
    else:
        one = st.floats(width=32 if field.type == "float32" else 64)
    if field.container is Container.SCALAR:
        return one
    fixed = field.container is Container.ARRAY
    most = field.size if fixed or field.size else 3
    return st.lists(one, min_size=field.size if fixed else 0, max_size=most)


ENCODINGS = st.sampled_from((Encoding.CDR, Encoding.CDR, Encoding.ROS1))


@st.composite
def messages(draw: st.DrawFn) -> tuple[Definition, Encoding, list[bytes]]:
    definition, encoding = draw(definitions()), draw(ENCODINGS)
    values = draw(st.lists(values_of(definition, definition.root), min_size=1, max_size=5))
    order = [draw(st.booleans()) if encoding is Encoding.CDR else False for _ in values]
    payloads = [
        Serializer(definition, encoding, big_endian=big).from_dict(value)
        for value, big in zip(values, order, strict=True)
    ]
    picks = draw(st.lists(st.integers(0, len(payloads) - 1), min_size=1, max_size=60))
    return definition, encoding, [payloads[pick] for pick in picks]


@RELAXED
@given(case=messages())
def test_columns_equal_rows_for_any_definition_and_values(
    assert_agree: AssertAgree, case: tuple[Definition, Encoding, list[bytes]]
) -> None:
    definition, encoding, payloads = case
    assert not assert_agree(payloads, definition, encoding).failures


@RELAXED
@given(case=messages(), data=st.data())
def test_columns_equal_rows_for_damaged_messages(
    assert_agree: AssertAgree, case: tuple[Definition, Encoding, list[bytes]], data: st.DataObject
) -> None:
    definition, encoding, payloads = case
    assert_agree([data.draw(damaged(payload)) for payload in payloads], definition, encoding)


@st.composite
def damaged(draw: st.DrawFn, payload: bytes) -> bytes:
    how = draw(st.sampled_from(("as it is", "as it is", "byte", "word", "cut", "more", "anything")))
    place = draw(st.integers(0, max(len(payload) - 1, 0)))
    if how == "byte":
        return payload[:place] + bytes([draw(st.integers(0, 255))]) + payload[place + 1 :]
    if how == "word":
        word = struct.pack("<I", draw(st.one_of(st.integers(0, 9), st.just(2**32 - 1), st.just(2**31))))
        return payload[:place] + word + payload[place + 4 :]
    if how == "cut":
        return payload[:place]
    if how == "more":
        return payload + draw(st.one_of(st.binary(max_size=9), st.integers(0, 9).map(bytes)))
    return draw(st.binary(max_size=40)) if how == "anything" else payload


def same_offsets(one: StepOffsets, other: StepOffsets) -> bool:
    return (
        one.at.tolist() == other.at.tolist()
        and one.counts.tolist() == other.counts.tolist()
        and len(one.body) == len(other.body)
        and all(map(same_offsets, one.body, other.body))
    )


def same_located(one: LocatedMessages, other: LocatedMessages) -> bool:
    return (
        one.rows.tolist() == other.rows.tolist()
        and one.tails.tolist() == other.tails.tolist()
        and all(map(same_offsets, one.offsets, other.offsets))
    )


@RELAXED
@given(case=messages(), data=st.data(), few=st.integers(0, 3))
def test_locate_all_methods_return_equal_offsets(
    batch_of: BatchOf, case: tuple[Definition, Encoding, list[bytes]], data: st.DataObject, few: int
) -> None:
    definition, encoding, payloads = case
    payloads = [data.draw(damaged(payload)) for payload in payloads]
    layout = compile_layout(definition, encoding)
    batch = batch_of(payloads)
    skip = 4 if encoding is Encoding.CDR else 0
    rows = np.flatnonzero(batch.lengths >= skip)
    origins = batch.starts[rows] + skip
    payloads = Payloads(batch.data, "<", origins, batch.starts[rows] + batch.lengths[rows])
    slow = locate_one_by_one(layout, payloads)
    assert same_located(locate(layout, payloads), slow)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lockstep, "FEW", few)
        assert same_located(locate_lockstep(layout, payloads), slow)
