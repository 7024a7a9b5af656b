"""This file decodes all messages of a batch at once, and leaves those that may not fit to the row-wise decoder."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.batch import Encoding, RawBatch
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.decode.columns import build_columns
from mosaico_ingest.decode.decoder import Decoded
from mosaico_ingest.decode.gather import array_of, bytes_at
from mosaico_ingest.decode.layout import PADDING, compile_layout
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

    def _in_two(self, batch: RawBatch, total: int) -> Decoded:
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
                where=batch.channel.topic,
                hint="read smaller batches",
            ) from error
        index = np.concatenate([first.index, second.index + edges[1]])
        later = (replace(failure, row=failure.row + edges[1]) for failure in second.failures)
        return Decoded(rows, index, (*first.failures, *later), first.padded + second.padded)

    def _by_order(self, batch: RawBatch) -> list[tuple[str, Int64s]]:
        """Return the positions of the messages of each byte order, without those of none."""
        if self._layout.encoding is Encoding.ROS1:
            return [("<", np.arange(len(batch)))] if len(batch) else []
        rows = np.flatnonzero(batch.lengths >= _HEADER)
        first, second = (bytes_at(batch.data, batch.starts[rows] + place) for place in range(2))
        groups = [(order, rows[(first == 0) & (second == kind)]) for order, kind in _ORDERS.items()]
        return [(order, members) for order, members in groups if len(members)]

    def _by_columns(self, batch: RawBatch, order: str, rows: Int64s) -> Decoded:
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

    def _by_rows(self, batch: RawBatch, rows: Int64s) -> Decoded:
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
