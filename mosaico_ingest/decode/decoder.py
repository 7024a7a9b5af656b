"""Decoders of one connection: columnar, with row-wise decoding as fallback and reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.decode.base import Decoded, Decoder, DictDecoder, merge_parts
from mosaico_ingest.decode.columns import build_columns
from mosaico_ingest.decode.layout import PADDING, compile_layout
from mosaico_ingest.decode.lockstep import locate
from mosaico_ingest.decode.spans import Int64s, Payloads, bytes_at
from mosaico_ingest.errors import DecodeError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Language
from mosaico_ingest.rosbag.serialization import Deserializer


class RowwiseDecoder:
    """Decodes each message to a dictionary, and the dictionaries to Arrow.

    Raises:
        DecodeError: The definition has no Arrow shape.
    """

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        self._deserializer = Deserializer(definition, encoding)
        self._decoder = DictDecoder(ros_shape(definition), self._deserializer)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._decoder.shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        padded = self._deserializer.padded
        decoded = self._decoder.decode(block)
        return replace(decoded, padded=self._deserializer.padded - padded)


_HEADER = 4
_LARGEST = 2**31 - 1
_FEW, _SMALL = 8, 4096
"""Up to this many messages and bytes in total, row-wise decoding is faster."""
_ORDERS = {">": 0, "<": 1}
"""The second byte of the encapsulation header of plain CDR."""


class ColumnarDecoder:
    """Decodes by columns. Messages that it cannot decode are decoded by `RowwiseDecoder`, which is authoritative.

    Raises:
        DecodeError: The definition has no Arrow shape.
    """

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        self._definition = definition
        self._rowwise = RowwiseDecoder(definition, encoding)
        self._layout = compile_layout(definition, encoding)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._rowwise.shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block.

        Raises:
            DecodeError: A column of the block would exceed 2 GiB.
        """
        total = int(block.lengths.sum())
        if total > _LARGEST:
            return self._in_two(block, total)
        if len(block) <= _FEW and total <= _SMALL:
            return self._rowwise.decode(block)
        parts = [self._by_columns(block, order, rows) for order, rows in self._by_order(block)]
        is_remaining = np.ones(len(block), bool)
        for part in parts:
            is_remaining[part.index] = False
        if is_remaining.any() or not parts:
            parts.append(self._by_rows(block, np.flatnonzero(is_remaining)))
        return merge_parts(parts)

    def _in_two(self, block: MessageBlock, total: int) -> Decoded:
        """Decode a block too large for the 32-bit offsets of a column in two halves."""
        if len(block) == 1:
            reason = f"a message of {total} bytes; the limit is {_LARGEST} bytes"
            none = self._rowwise.decode(block.rows(slice(0)))
            return replace(none, failures=(RowFailure(0, "too-large", reason),))
        middle = int(np.searchsorted(np.cumsum(block.lengths), total // 2)) + 1
        edges = (0, min(middle, len(block) - 1), len(block))
        first, second = (self.decode(block.rows(slice(start, end))) for start, end in pairwise(edges))
        try:
            rows = pa.concat_arrays([first.rows, second.rows])
        except pa.ArrowInvalid as error:
            raise DecodeError(
                f"a column of a block of {total} bytes exceeds {_LARGEST} bytes",
                rule="batch-size",
                where=self._definition.root,
                hint="lower the memory limit, so that smaller blocks are read",
            ) from error
        index = np.concatenate([first.index, second.index + edges[1]])
        later = (replace(failure, row=failure.row + edges[1]) for failure in second.failures)
        return Decoded(rows, index, (*first.failures, *later), first.padded + second.padded)

    def _by_order(self, block: MessageBlock) -> list[tuple[str, Int64s]]:
        """Return the positions of the messages of each byte order; omit messages without a valid header."""
        if self._layout.encoding is Encoding.ROS1:
            return [("<", np.arange(len(block)))] if len(block) else []
        rows = np.flatnonzero(block.lengths >= _HEADER)
        first, second = (bytes_at(block.data, block.starts[rows] + offset) for offset in range(2))
        groups = [(order, rows[(first == 0) & (second == kind)]) for order, kind in _ORDERS.items()]
        return [(order, members) for order, members in groups if len(members)]

    def _by_columns(self, block: MessageBlock, order: str, rows: Int64s) -> Decoded:
        """Decode the valid ones of some messages of one byte order."""
        skip = _HEADER if self._layout.encoding is Encoding.CDR else 0
        starts, lengths = block.starts[rows], block.lengths[rows]
        payloads = Payloads(np.ascontiguousarray(block.data), order, starts + skip, starts + lengths)
        located = locate(self._layout, payloads)
        values, invalid = build_columns(self._layout, self.shape, payloads, located)
        if len(invalid):
            located = located.take(np.delete(np.arange(len(located.rows)), invalid))
            values, _ = build_columns(self._layout, self.shape, payloads, located)
        return Decoded(values, rows[located.rows], (), int((located.tails > PADDING).sum()))

    def _by_rows(self, block: MessageBlock, rows: Int64s) -> Decoded:
        """Decode some messages one by one."""
        return self._rowwise.decode(block.rows(rows)).relocated(rows)


def _decode_ros(definition: Definition, encoding: Encoding) -> Decoder:
    return ColumnarDecoder(definition, encoding)


def _decode_protobuf(definition: Definition, encoding: Encoding) -> Decoder:  # noqa: ARG001 - the table's signature
    from mosaico_ingest.decode.protobuf import ProtobufDecoder  # noqa: PLC0415 - ROS recordings do not need it

    return ProtobufDecoder(definition)


def _decode_json(definition: Definition, encoding: Encoding) -> Decoder:  # noqa: ARG001 - the table's signature
    from mosaico_ingest.decode.json import JsonDecoder  # noqa: PLC0415 - ROS recordings do not need it

    return JsonDecoder(definition)


DECODERS: Mapping[Encoding, Callable[[Definition, Encoding], Decoder]] = {
    Encoding.CDR: _decode_ros,
    Encoding.ROS1: _decode_ros,
    Encoding.PROTOBUF: _decode_protobuf,
    Encoding.JSON: _decode_json,
}
"""The decoder of each encoding that can be decoded."""


def decoder_for(connection: Connection) -> Decoder:
    """Return the decoder of a connection.

    Raises:
        DecodeError: There is no decoder for the encoding, or the connection has no definition with an Arrow shape.
    """
    if connection.encoding not in DECODERS:
        raise DecodeError(
            connection.problem or "there is no decoder", rule="encoding", where=connection.topic
        )
    if connection.definition is None:
        raise DecodeError(
            f"no definition of {connection.msgtype}: {connection.problem or 'the recording has none'}",
            rule="definition",
            where=connection.topic,
        )
    return _decoder(_DefinitionKey(connection.definition), connection.encoding)


class _DefinitionKey(Struct, frozen=True):
    """A definition as a cache key: equal if the root, ROS version and fields are equal.

    Schemas in other languages must be equal as text, because a JSON Schema has more than fields.
    """

    definition: Definition

    def __hash__(self) -> int:
        return hash((self.definition.root, self.definition.text))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _DefinitionKey):
            return NotImplemented
        own, others = self.definition, other.definition
        if (own.root, own.ros_version, own.types, own.shape) != (
            others.root,
            others.ros_version,
            others.types,
            others.shape,
        ):
            return False
        return own.language is Language.ROS or own.text == others.text


@lru_cache(maxsize=128)
def _decoder(key: _DefinitionKey, encoding: Encoding) -> Decoder:
    """Return a cached decoder; decoders have no state, so that several recordings can share one."""
    return DECODERS[encoding](key.definition, encoding)
