"""Decoders of one connection: columnar, and row-wise as its fallback and oracle."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.decode.columns import build_columns
from mosaico_ingest.decode.layout import PADDING, compile_layout
from mosaico_ingest.decode.lockstep import locate
from mosaico_ingest.decode.spans import Frame, Int64s, array_of, bytes_at
from mosaico_ingest.errors import DecodeError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.serialization import Deserializer

__all__ = [
    "ColumnarDecoder",
    "Decoded",
    "Decoder",
    "RowwiseDecoder",
    "decoder_for",
]


class Decoded(Struct, frozen=True):
    """The rows that could be decoded, which messages they were, and the ones that could not."""

    rows: pa.StructArray
    """One row a good message, in the ROS shape, no null rows."""
    index: NDArray[np.int64]
    """Position in the batch of each row, ascending, shape (len(rows),)."""
    failures: tuple[RowFailure, ...]
    """`row` is the position in the batch; len(index) + len(failures) = len(batch)."""
    padded: int = 0
    """How many rows end in 4 to 7 zero bytes which the definition does not account for."""


class Decoder(Protocol):
    """Decodes batches of one connection; any bytes give rows or failures, never an exception."""

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape: the type of `Decoded.rows`."""
        ...

    def decode(self, batch: MessageBlock) -> Decoded:
        """Decode all messages of the batch."""
        ...


class RowwiseDecoder:
    """Decodes each message into plain values, and those into Arrow.

    Raises:
        DecodeError: The definition has no Arrow shape.
    """

    def __init__(self, definition: Definition, encoding: Encoding) -> None:
        self._shape = ros_shape(definition)
        self._deserializer = Deserializer(definition, encoding)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._shape

    def decode(self, batch: MessageBlock) -> Decoded:
        """Decode all messages of the batch."""
        values: list[dict[str, Any]] = []
        index: list[int] = []
        failures: list[RowFailure] = []
        padded = self._deserializer.padded
        for row in range(len(batch)):
            try:
                values.append(self._deserializer.to_dict(batch.payload(row)))
                index.append(row)
            except DecodeError as error:  # noqa: PERF203 - a bad row costs a row
                failures.append(RowFailure(row, error.rule, str(error)))
        # An array of a struct type is one of structs, which the stubs cannot know.
        rows = cast("pa.StructArray", pa.array(values, type=self._shape))
        padded = self._deserializer.padded - padded
        return Decoded(rows, np.array(index, np.int64), tuple(failures), padded)


_HEADER = 4
_LARGEST = 2**31 - 1
_FEW, _SMALL = 8, 4096
"""Messages, and bytes in all, up to which building columns costs more than it saves."""
_ORDERS = {">": 0, "<": 1}
"""The second byte of the encapsulation header of plain CDR."""


class ColumnarDecoder:
    """Decodes by columns; what `RowwiseDecoder` says about a message is what counts.

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

    def decode(self, batch: MessageBlock) -> Decoded:
        """Decode all messages of the batch.

        Raises:
            DecodeError: A column of the batch would be larger than the 2 GiB it can hold.
        """
        total = int(batch.lengths.sum())
        if total > _LARGEST:
            return self._in_two(batch, total)
        if len(batch) <= _FEW and total <= _SMALL:
            return self._rowwise.decode(batch)
        parts = [self._by_columns(batch, order, rows) for order, rows in self._by_order(batch)]
        left = np.ones(len(batch), bool)
        for part in parts:
            left[part.index] = False
        if left.any() or not parts:
            parts.append(self._by_rows(batch, np.flatnonzero(left)))
        return _merge(parts)

    def _in_two(self, batch: MessageBlock, total: int) -> Decoded:
        """Decode a batch too large for the offsets of a column, half of its bytes after the other."""
        if len(batch) == 1:
            reason = f"{total} bytes, a message can have {_LARGEST}"
            none = self._rowwise.decode(batch.rows(slice(0)))
            return replace(none, failures=(RowFailure(0, "too-large", reason),))
        middle = int(np.searchsorted(np.cumsum(batch.lengths), total // 2)) + 1
        edges = (0, min(middle, len(batch) - 1), len(batch))
        first, second = (self.decode(batch.rows(slice(begin, end))) for begin, end in pairwise(edges))
        try:
            rows = pa.concat_arrays([first.rows, second.rows])
        except pa.ArrowInvalid as error:
            raise DecodeError(
                f"a batch of {total} bytes, a column holds {_LARGEST}",
                rule="batch-size",
                where=self._definition.root,
                hint="read smaller batches",
            ) from error
        index = np.concatenate([first.index, second.index + edges[1]])
        later = (replace(failure, row=failure.row + edges[1]) for failure in second.failures)
        return Decoded(rows, index, (*first.failures, *later), first.padded + second.padded)

    def _by_order(self, batch: MessageBlock) -> list[tuple[str, Int64s]]:
        """Return the positions of the messages of each byte order, without those of none."""
        if self._layout.encoding is Encoding.ROS1:
            return [("<", np.arange(len(batch)))] if len(batch) else []
        rows = np.flatnonzero(batch.lengths >= _HEADER)
        first, second = (bytes_at(batch.data, batch.starts[rows] + place) for place in range(2))
        groups = [(order, rows[(first == 0) & (second == kind)]) for order, kind in _ORDERS.items()]
        return [(order, members) for order, members in groups if len(members)]

    def _by_columns(self, batch: MessageBlock, order: str, rows: Int64s) -> Decoded:
        """Decode those of some messages, all of one byte order, that can be vouched for."""
        skip = _HEADER if self._layout.encoding is Encoding.CDR else 0
        starts, lengths = batch.starts[rows], batch.lengths[rows]
        frame = Frame(np.ascontiguousarray(batch.data), order, starts + skip, starts + lengths)
        located = locate(self._layout, frame)
        values, unread = build_columns(self._layout, self.shape, frame, located)
        if len(unread):
            located = located.take(np.delete(np.arange(len(located.rows)), unread))
            values, _ = build_columns(self._layout, self.shape, frame, located)
        return Decoded(values, rows[located.rows], (), int((located.tails > PADDING).sum()))

    def _by_rows(self, batch: MessageBlock, rows: Int64s) -> Decoded:
        """Decode some messages one by one."""
        decoded = self._rowwise.decode(batch.rows(rows))
        failures = tuple(replace(failure, row=int(rows[failure.row])) for failure in decoded.failures)
        return replace(decoded, index=rows[decoded.index], failures=failures)


def _merge(parts: list[Decoded]) -> Decoded:
    """Put parts of one batch together in its order; only the last can have failures."""
    failures, padded = parts[-1].failures, sum(part.padded for part in parts)
    filled = [part for part in parts if len(part.index)] or parts[:1]
    if len(filled) == 1:
        return Decoded(filled[0].rows, filled[0].index, failures, padded)
    index = np.concatenate([part.index for part in filled])
    order = np.argsort(index)
    rows = pa.concat_arrays([part.rows for part in filled]).take(array_of(pa.int64(), len(order), order))
    return Decoded(rows, index[order], failures, padded)


def decoder_for(connection: Connection) -> Decoder:
    """Return the decoder of a connection's messages.

    Raises:
        DecodeError: The connection is not in a ROS encoding, has no definition, or one without an Arrow shape.
    """
    if connection.encoding is Encoding.OTHER:
        raise DecodeError(
            f"the messages are not in a ROS encoding ({connection.attributes.get('encoding', 'unknown')})",
            rule="encoding",
            where=connection.topic,
        )
    if connection.definition is None:
        raise DecodeError(
            f"no definition of {connection.msgtype}: {connection.problem or 'the recording has none'}",
            rule="definition",
            where=connection.topic,
        )
    return _decoder(_Known(connection.definition), connection.encoding)


class _Known(Struct, frozen=True):
    """A definition, told from others by what a decoder needs to know of it."""

    definition: Definition

    def __hash__(self) -> int:
        return hash((self.definition.root, self.definition.text))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Known):
            return NotImplemented
        own, others = self.definition, other.definition
        return (own.root, own.ros_version, own.types) == (others.root, others.ros_version, others.types)


@lru_cache(maxsize=128)
def _decoder(known: _Known, encoding: Encoding) -> Decoder:
    """Return a decoder, the same one for each recording of a batch: it remembers nothing of what it decodes."""
    return ColumnarDecoder(known.definition, encoding)
