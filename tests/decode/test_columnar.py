from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

import numpy as np
import pyarrow as pa
import pytest
from msgspec.structs import replace

from mosaico_ingest.decode import decoder as columnar
from mosaico_ingest.decode.decoder import ColumnarDecoder, Decoded, decoder_for
from mosaico_ingest.errors import DecodeError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Serializer

BatchOf = Callable[[Sequence[bytes]], MessageBlock]
AssertAgree = Callable[[Sequence[bytes], Definition, Encoding], Decoded]

HUMBLE = TypeResolver(Stores.ROS2_HUMBLE)
STRING = HUMBLE.resolve("std_msgs/msg/String", None, ros_version=2)
IMAGE = HUMBLE.resolve("sensor_msgs/msg/CompressedImage", None, ros_version=2)
LITTLE, BIG = b"\0\1\0\0", b"\0\0\0\0"


def message(*fields: Field) -> Definition:
    return Definition("test/msg/T", {"test/msg/T": MessageType("test/msg/T", fields)}, Source.BAG, "", 2)


def text(value: bytes, order: str = "<") -> bytes:
    return (LITTLE if order == "<" else BIG) + struct.pack(f"{order}I", len(value) + 1) + value + b"\0"


def test_columnar_wrong_length_rejects_only_its_row(assert_agree: AssertAgree) -> None:
    numbers = message(Field("v", "float64", container=Container.SEQUENCE))
    lie = LITTLE + struct.pack("<I", 2**32 - 1)
    good = Serializer(numbers, Encoding.CDR).from_dict({"v": [1.0, 2.0]})
    decoded = assert_agree([good, lie, good] * 20, numbers, Encoding.CDR)
    assert [failure.rule for failure in decoded.failures] == ["sequence-length"] * 20
    assert decoded.rows.field("v").to_pylist() == [[1.0, 2.0]] * 40


def test_columnar_invalid_loop_element_rejects_only_its_row(assert_agree: AssertAgree) -> None:
    names = message(Field("v", "string", container=Container.SEQUENCE), Field("end", "uint32"))
    serializer = Serializer(names, Encoding.CDR)
    good = [serializer.from_dict({"v": ["ab"] * (number % 7), "end": number}) for number in range(60)]
    bad = good[5][:16] + struct.pack("<I", 2**31) + good[5][20:]
    decoded = assert_agree([*good[:30], bad, bad, *good[30:]], names, Encoding.CDR)
    assert [failure.row for failure in decoded.failures] == [30, 31]
    assert decoded.rows.field("end").to_pylist() == list(range(60))


def test_columnar_both_byte_orders_in_one_block(assert_agree: AssertAgree) -> None:
    payloads = [text(b"a"), text(b"bcd", ">"), text(b""), text(b"e", ">")] * 10
    decoded = assert_agree(payloads, STRING, Encoding.CDR)
    assert decoded.rows.field("data").to_pylist() == ["a", "bcd", "", "e"] * 10


@pytest.mark.parametrize(
    ("payload", "rule"),
    [
        (b"", "encapsulation"),
        (b"\0\2\0\0", "pl-cdr"),
        (b"\0\7\0\0", "xcdr2"),
        (text(b"a")[:-1], "string-length"),
        (text(b"a")[:-1] + b"b", "string-terminator"),
        (text(b"\xff"), "utf8"),
        (text(b"\xed\xa0\x80"), "utf8"),
        (text(b"a") + bytes(8), "trailing-bytes"),
        (text(b"a") + b"\0\0\0\1", "trailing-bytes"),
    ],
)
@pytest.mark.parametrize("others", [2, 50])
def test_columnar_invalid_message_has_rule(
    assert_agree: AssertAgree, payload: bytes, rule: str, others: int
) -> None:
    good = [text(b"x" * (number % 3)) for number in range(others)]
    decoded = assert_agree([*good, payload, *good], STRING, Encoding.CDR)
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(others, rule)]


@pytest.mark.promise("trailing-bytes")
def test_columnar_trailing_padding_is_accepted(assert_agree: AssertAgree) -> None:
    payloads = [text(b"a" * (number % 4)) + bytes(number % 8) for number in range(64)]
    decoded = assert_agree(payloads, STRING, Encoding.CDR)
    assert (len(decoded.rows), decoded.padded) == (64, 32)


def test_columnar_nonzero_tail_in_template_group_is_rejected(assert_agree: AssertAgree) -> None:
    payloads = [text(b"abc") + bytes(6)] * 40
    payloads[33] = text(b"abc") + bytes(5) + b"\1"
    payloads[34] = text(b"abc") + b"\1" + bytes(5)
    decoded = assert_agree(payloads, STRING, Encoding.CDR)
    assert [failure.row for failure in decoded.failures] == [33, 34]


def test_columnar_non_ascii_and_wide_text(assert_agree: AssertAgree) -> None:
    wide = message(Field("v", "wstring", container=Container.SEQUENCE))
    values = [["", "é"], ["𝄞 clef", "plain"], ["漢字"]] * 12
    payloads = [Serializer(wide, Encoding.CDR).from_dict({"v": value}) for value in values]
    assert assert_agree(payloads, wide, Encoding.CDR).rows.field("v").to_pylist() == values
    assert not assert_agree([text("é漢𝄞".encode())] * 20, STRING, Encoding.CDR).failures


def test_bool_nonzero_byte_is_true(assert_agree: AssertAgree) -> None:
    flag = message(Field("v", "bool"))
    decoded = assert_agree([LITTLE + bytes([value]) for value in range(256)], flag, Encoding.CDR)
    assert decoded.rows.field("v").to_pylist() == [False] + [True] * 255


def test_columnar_message_without_fields_is_a_row(assert_agree: AssertAgree) -> None:
    empty = message()
    assert len(assert_agree([LITTLE, LITTLE + b"\0", LITTLE + bytes(4)], empty, Encoding.CDR).rows) == 3
    assert len(assert_agree([b"", b"", b"\0"], empty, Encoding.ROS1).rows) == 2


def test_columnar_empty_block_has_no_rows(assert_agree: AssertAgree) -> None:
    assert len(assert_agree([], STRING, Encoding.CDR).rows) == 0


def test_columnar_payloads_in_any_buffer_order(batch_of: BatchOf) -> None:
    batch = batch_of([text(bytes([97 + number] * (number % 5))) for number in range(26)])
    mixed = np.random.default_rng(3).permutation(26)
    shuffled = replace(batch, starts=batch.starts[mixed], lengths=batch.lengths[mixed])
    decoder = ColumnarDecoder(STRING, Encoding.CDR)
    expected = np.array(decoder.decode(batch).rows.field("data").to_pylist())[mixed]
    assert decoder.decode(shuffled).rows.field("data").to_pylist() == expected.tolist()


def test_columnar_single_blob_is_not_copied(batch_of: BatchOf) -> None:
    blob = np.random.default_rng(2).bytes(100_000)
    value = {"header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "c"}, "format": "jpeg", "data": blob}
    batch = batch_of([Serializer(IMAGE, Encoding.CDR).from_dict(value)])
    data = ColumnarDecoder(IMAGE, Encoding.CDR).decode(batch).rows.field("data")
    assert data[0].as_py() == blob
    assert np.shares_memory(np.frombuffer(data.buffers()[2], np.uint8), batch.data)


def test_columnar_column_overflow_raises(batch_of: BatchOf, monkeypatch: pytest.MonkeyPatch) -> None:
    def overflow(_: object) -> None:
        raise pa.ArrowInvalid("offset overflow while concatenating arrays")

    batch = batch_of([text(b"a" * 20)] * 12)
    monkeypatch.setattr(columnar, "_LARGEST", 200)
    monkeypatch.setattr(columnar.pa, "concat_arrays", overflow)
    with pytest.raises(DecodeError, match="smaller blocks are read"):
        ColumnarDecoder(STRING, Encoding.CDR).decode(batch)


def connection(encoding: Encoding, definition: Definition | None) -> Connection:
    return Connection(
        1,
        "/t",
        "a/msg/B",
        encoding,
        0,
        definition,
        None if definition else "no text",
        attributes={"encoding": "json"},
    )


def test_decoder_for_undecodable_connection_raises() -> None:
    with pytest.raises(DecodeError, match="/t: there is no decoder"):
        decoder_for(connection(Encoding.OTHER, STRING))
    with pytest.raises(DecodeError, match="/t: no definition of a/msg/B: no text"):
        decoder_for(connection(Encoding.CDR, None))
    assert decoder_for(connection(Encoding.CDR, STRING)).shape.names == ["data"]


@pytest.mark.parametrize("largest", [40, 64, 100, 10_000])
def test_columnar_block_too_large_is_split(
    largest: int, batch_of: BatchOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    payloads = [text(b"x" * (number % 30)) for number in range(200)]
    payloads[60] = payloads[120] = LITTLE
    batch = batch_of(payloads)
    whole = ColumnarDecoder(STRING, Encoding.CDR).decode(batch)
    monkeypatch.setattr(columnar, "_LARGEST", largest)
    parts = ColumnarDecoder(STRING, Encoding.CDR).decode(batch)
    assert parts.rows.equals(whole.rows)
    assert parts.index.tolist() == whole.index.tolist()
    assert parts.failures == whole.failures
    assert [failure.row for failure in whole.failures] == [60, 120]


def test_columnar_message_too_large_rejects_its_row(
    batch_of: BatchOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = batch_of([text(b"ab"), text(b"x" * 500), text(b"cd")])
    monkeypatch.setattr(columnar, "_LARGEST", 200)
    decoded = ColumnarDecoder(STRING, Encoding.CDR).decode(batch)
    assert decoded.rows.field("data").to_pylist() == ["ab", "cd"]
    assert [(failure.row, failure.rule) for failure in decoded.failures] == [(1, "too-large")]
