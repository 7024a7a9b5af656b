"""This file decodes all messages of a batch at once, and leaves those it cannot vouch for to the row-wise decoder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.batch import Encoding, RawBatch
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.decode.columns import build_columns
from mosaico_ingest.decode.decoder import Decoded
from mosaico_ingest.decode.layout import compile_layout
from mosaico_ingest.decode.locate import locate
from mosaico_ingest.decode.places import Frame, Int64s
from mosaico_ingest.decode.rowwise import RowwiseDecoder
from mosaico_ingest.diagnostics import RowFailure
from mosaico_ingest.errors import DecodeError

__all__ = ["ColumnarDecoder"]

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
        self._rowwise = RowwiseDecoder(definition, encoding)
        self._layout = compile_layout(definition, encoding)

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape."""
        return self._rowwise.shape

    def decode(self, batch: RawBatch) -> Decoded:
        """Decode all messages of the batch.

        Raises:
            DecodeError: The batch is larger than the 2 GiB a column can hold.
        """
        total = int(batch.lengths.sum())
        if total > _LARGEST:
            raise DecodeError(
                f"a batch of {total} bytes, columns hold {_LARGEST}",
                rule="batch-size",
                where=batch.channel.topic,
                hint="read smaller batches",
            )
        if len(batch) <= _FEW and total <= _SMALL:
            return self._rowwise.decode(batch)
        left = np.ones(len(batch), bool)
        parts: list[tuple[Int64s, pa.StructArray]] = []
        for order, members in self._by_order(batch):
            found, rows = self._decode(_frame(batch, members, order, self._layout.encoding))
            left[members[found]] = False
            parts.append((members[found], rows))
        rest = np.flatnonzero(left)
        failures: tuple[RowFailure, ...] = ()
        if len(rest) or not parts:
            slow = self._rowwise.decode(_take(batch, rest))
            parts.append((rest[slow.index], slow.rows))
            failures = tuple(replace(failure, row=int(rest[failure.row])) for failure in slow.failures)
        return _merge(parts, failures)

    def _by_order(self, batch: RawBatch) -> list[tuple[str, Int64s]]:
        """Return the positions of the messages of each byte order, without those of none."""
        if self._layout.encoding is Encoding.ROS1:
            return [("<", np.arange(len(batch)))] if len(batch) else []
        rows = np.flatnonzero(batch.lengths >= _HEADER)
        first, second = batch.data[batch.starts[rows]], batch.data[batch.starts[rows] + 1]
        groups = [(order, rows[(first == 0) & (second == kind)]) for order, kind in _ORDERS.items()]
        return [(order, members) for order, members in groups if len(members)]

    def _decode(self, frame: Frame) -> tuple[Int64s, pa.StructArray]:
        """Return the rows that could be decoded here, ascending positions in the frame, and their values."""
        located = locate(self._layout, frame)
        rows, unread = build_columns(self._layout, self.shape, frame, located)
        if len(unread):
            located = located.take(np.delete(np.arange(len(located.rows)), unread))
            rows, _ = build_columns(self._layout, self.shape, frame, located)
        return located.rows, rows


def _frame(batch: RawBatch, rows: Int64s, order: str, encoding: Encoding) -> Frame:
    starts = batch.starts[rows]
    origins = starts + _HEADER if encoding is Encoding.CDR else starts
    return Frame(np.ascontiguousarray(batch.data), order, origins, starts + batch.lengths[rows])


def _take(batch: RawBatch, rows: Int64s) -> RawBatch:
    return replace(
        batch,
        log_times=batch.log_times[rows],
        starts=batch.starts[rows],
        lengths=batch.lengths[rows],
        offsets=batch.offsets[rows],
    )


def _merge(parts: list[tuple[Int64s, pa.StructArray]], failures: tuple[RowFailure, ...]) -> Decoded:
    filled = [part for part in parts if len(part[0])] or parts[:1]
    if len(filled) == 1:
        return Decoded(filled[0][1], filled[0][0], failures)
    index = np.concatenate([rows for rows, _ in filled])
    order = np.argsort(index)
    rows = pa.concat_arrays([values for _, values in filled]).take(order)
    return Decoded(rows, index[order], failures)
