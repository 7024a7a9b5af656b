"""The common behavior of all decoders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.decode.decoder import ColumnarDecoder, Decoder, RowwiseDecoder
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Serializer

MakeDecoder = Callable[[Definition, Encoding], Decoder]
CASES = {
    Encoding.CDR: TypeResolver(Stores.ROS2_HUMBLE).resolve("sensor_msgs/msg/JointState", None, ros_version=2),
    Encoding.ROS1: TypeResolver(Stores.ROS1_NOETIC).resolve(
        "sensor_msgs/msg/JointState", None, ros_version=1
    ),
}


@pytest.fixture(params=[ColumnarDecoder, RowwiseDecoder], ids=["columnar", "rowwise"])
def make(request: pytest.FixtureRequest) -> MakeDecoder:
    return request.param


@pytest.fixture(params=list(CASES), ids=[encoding.value for encoding in CASES])
def encoding(request: pytest.FixtureRequest) -> Encoding:
    return request.param


def joint_state(encoding: Encoding, number: int) -> dict[str, object]:
    header: dict[str, object] = {"stamp": {"sec": number, "nanosec": 5}, "frame_id": "é" * (number % 3)}
    if encoding is Encoding.ROS1:
        header = {"seq": number, **header}
    names = [f"joint_{place}" for place in range(number % 4)]
    return {
        "header": header,
        "name": names,
        "position": [0.5] * number,
        "velocity": [],
        "effort": [float(number)],
    }


def batch_of(payloads: list[bytes], encoding: Encoding) -> MessageBlock:
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    definition = CASES[encoding]
    channel = Connection(7, "/joints", definition.root, encoding, len(payloads), definition)
    number = np.arange(len(payloads), dtype=np.int64)
    data = np.frombuffer(b"".join(payloads), np.uint8)
    return MessageBlock(channel.id, number, data, np.cumsum(lengths) - lengths, lengths, number)


def payloads_of(encoding: Encoding, count: int) -> list[bytes]:
    serializer = Serializer(CASES[encoding], encoding)
    return [serializer.from_dict(joint_state(encoding, number)) for number in range(count)]


def test_decoder_returns_messages_in_the_ros_shape(make: MakeDecoder, encoding: Encoding) -> None:
    decoder = make(CASES[encoding], encoding)
    decoded = decoder.decode(batch_of(payloads_of(encoding, 40), encoding))
    assert decoder.shape == ros_shape(CASES[encoding]) == decoded.rows.type
    assert decoded.rows.to_pylist() == [joint_state(encoding, number) for number in range(40)]
    assert decoded.rows.null_count == 0


def test_decoder_index_gives_the_message_of_every_row(make: MakeDecoder, encoding: Encoding) -> None:
    decoded = make(CASES[encoding], encoding).decode(batch_of(payloads_of(encoding, 5), encoding))
    assert decoded.index.dtype == np.int64
    assert decoded.index.tolist() == [0, 1, 2, 3, 4]
    assert decoded.failures == ()


def test_decoder_bad_message_rejects_only_its_row(make: MakeDecoder, encoding: Encoding) -> None:
    payloads = payloads_of(encoding, 30)
    payloads[11] = payloads[11][:-3]
    payloads[20] = b""
    decoded = make(CASES[encoding], encoding).decode(batch_of(payloads, encoding))
    assert [failure.row for failure in decoded.failures] == [11, 20]
    assert all(failure.rule and failure.reason for failure in decoded.failures)
    assert decoded.index.tolist() == [row for row in range(30) if row not in {11, 20}]
    assert [
        stamp["sec"] for stamp in decoded.rows.field("header").field("stamp").to_pylist()
    ] == decoded.index.tolist()


def test_decoder_random_bytes_give_a_row_or_a_failure_each(make: MakeDecoder, encoding: Encoding) -> None:
    random = np.random.default_rng(5)
    payloads = [random.bytes(int(random.integers(0, 80))) for _ in range(200)]
    decoded = make(CASES[encoding], encoding).decode(batch_of(payloads, encoding))
    assert len(decoded.rows) == len(decoded.index)
    assert sorted([*decoded.index.tolist(), *(failure.row for failure in decoded.failures)]) == list(
        range(200)
    )
    decoded.rows.validate(full=True)


def test_decoder_empty_block_gives_no_rows(make: MakeDecoder, encoding: Encoding) -> None:
    decoded = make(CASES[encoding], encoding).decode(batch_of([], encoding))
    assert len(decoded.rows) == len(decoded.index) == len(decoded.failures) == 0
    assert isinstance(decoded.rows, pa.StructArray)
