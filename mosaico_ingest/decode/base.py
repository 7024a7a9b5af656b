"""The contract of decoders, and the row-wise decoder of all encodings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.errors import DecodeError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.rosbag.blocks import Int64s, MessageBlock
from mosaico_ingest.rosbag.encodings import MessageReader


class Decoded(Struct, frozen=True):
    """The result of decoding a message block: rows, their positions in the block, and failures."""

    rows: pa.StructArray
    """One row per decoded message. ROS messages have no nulls; in other encodings, absent values are null."""
    index: NDArray[np.int64]
    """Position of each row in the block, ascending, shape (len(rows),)."""
    failures: tuple[RowFailure, ...]
    """`row` is the position in the block; len(index) + len(failures) = len(block)."""
    padded: int = 0
    """Number of rows that end in 4 to 7 zero bytes that the definition does not explain."""
    undeclared: frozenset[str] = frozenset()
    """Fields of the messages that their schema does not declare, and that the rows do not contain."""

    def relocated(self, rows: Int64s) -> Decoded:
        """Return the result for a block of which the decoded messages are the rows `rows`."""
        failures = tuple(replace(failure, row=int(rows[failure.row])) for failure in self.failures)
        return replace(self, index=rows[self.index], failures=failures)


class Decoder(Protocol):
    """Decodes message blocks of one connection. Invalid bytes become failures, never exceptions."""

    @property
    def shape(self) -> pa.StructType:
        """The type of `Decoded.rows`."""
        ...

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        ...


class DictDecoder:
    """Decodes each message to a dictionary, and the dictionaries to Arrow."""

    def __init__(self, shape: pa.StructType, reader: MessageReader) -> None:
        self._shape = shape
        self._reader = reader

    @property
    def shape(self) -> pa.StructType:
        """The type of the rows."""
        return self._shape

    def decode(self, block: MessageBlock) -> Decoded:
        """Decode all messages of the block."""
        return self.decode_payloads(block.payload(row) for row in range(len(block)))

    def decode_payloads(self, payloads: Iterable[bytes]) -> Decoded:
        """Decode messages that are not in a block."""
        values: list[dict[str, Any]] = []
        index: list[int] = []
        failures: list[RowFailure] = []
        for row, payload in enumerate(payloads):
            try:
                values.append(self._reader.to_dict(payload))
                index.append(row)
            except DecodeError as error:  # noqa: PERF203 - each message may fail
                failures.append(RowFailure(row, error.rule, str(error)))
        # The stubs cannot express that an array of a struct type is a StructArray.
        rows = cast("pa.StructArray", pa.array(values, type=self._shape))
        return Decoded(rows, np.array(index, np.int64), tuple(failures))


def merge_parts(parts: list[Decoded]) -> Decoded:
    """Merge the parts of one block in the order of the messages."""
    filled = [part for part in parts if len(part.index)] or parts[:1]
    failures = sorted(
        (failure for part in parts for failure in part.failures), key=lambda failure: failure.row
    )
    padded = sum(part.padded for part in parts)
    undeclared = frozenset[str]().union(*(part.undeclared for part in parts))
    if len(filled) == 1:
        return Decoded(filled[0].rows, filled[0].index, tuple(failures), padded, undeclared)
    index = np.concatenate([part.index for part in filled])
    order = np.argsort(index)
    rows = pa.concat_arrays([part.rows for part in filled])
    if bool((order[1:] < order[:-1]).any()):
        rows = rows.take(pa.Array.from_buffers(pa.int64(), len(order), [None, pa.py_buffer(order.data)]))
    return Decoded(rows, index[order], tuple(failures), padded, undeclared)
