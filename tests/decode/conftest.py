"""Helpers of the decoder tests: message blocks from payloads, and a comparison of both decoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.decode import decoder as columnar
from mosaico_ingest.decode.decoder import ColumnarDecoder, Decoded, RowwiseDecoder
from mosaico_ingest.rosbag.blocks import Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import Definition


def make_batch(payloads: Sequence[bytes]) -> MessageBlock:
    """Return a message block of the payloads, with other bytes before, between and after them."""
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    gaps = 3 + np.arange(len(payloads)) % 5
    starts = np.cumsum(lengths + gaps) - lengths
    data = b"".join(b"\xff" * int(gap) + payload for gap, payload in zip(gaps, payloads, strict=True))
    number = np.arange(len(payloads), dtype=np.int64)
    return MessageBlock(0, number, np.frombuffer(data, np.uint8), starts, lengths, number)


def bits(array: pa.Array) -> Any:
    """Return comparable values of the array: NaN equals NaN, and 0.0 differs from -0.0."""
    kind = array.type
    if pa.types.is_struct(kind):
        return len(array), [bits(array.field(number)) for number in range(kind.num_fields)]
    if pa.types.is_list(kind):
        return array.value_lengths().to_pylist(), bits(array.flatten())
    if pa.types.is_fixed_size_list(kind):
        return len(array), bits(array.flatten())
    if pa.types.is_floating(kind):
        values = array.to_numpy(zero_copy_only=False).copy()
        values[np.isnan(values)] = np.nan  # a Python float cannot keep which NaN it was
        return values.tobytes()
    return array.to_pylist()


def check_same(fast: Decoded, slow: Decoded) -> None:
    fast.rows.validate(full=True)
    assert fast.rows.type.equals(slow.rows.type, check_metadata=True)
    assert fast.index.tolist() == slow.index.tolist()
    assert fast.failures == slow.failures
    assert fast.padded == slow.padded
    assert bits(fast.rows) == bits(slow.rows)


@pytest.fixture(scope="session", autouse=True)
def small_batches_by_columns() -> Iterator[None]:
    """Decode small batches by columns too; otherwise most random cases would compare rows with rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columnar, "_FEW", -1)
        yield


@pytest.fixture(scope="session")
def batch_of() -> Callable[[Sequence[bytes]], MessageBlock]:
    return make_batch


@pytest.fixture(scope="session")
def assert_same() -> Callable[[Decoded, Decoded], None]:
    return check_same


@pytest.fixture(scope="session")
def assert_agree() -> Callable[[Sequence[bytes], Definition, Encoding], Decoded]:
    """Decode the payloads with both decoders, compare them, and return the row-wise result."""

    def check(payloads: Sequence[bytes], definition: Definition, encoding: Encoding) -> Decoded:
        batch = make_batch(payloads)
        slow = RowwiseDecoder(definition, encoding).decode(batch)
        check_same(ColumnarDecoder(definition, encoding).decode(batch), slow)
        return slow

    return check
