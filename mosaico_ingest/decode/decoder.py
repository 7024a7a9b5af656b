"""This file is the decoder's seam: raw messages in, Arrow rows in the message's own shape out."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import RawBatch
from mosaico_ingest.diagnostics import RowFailure
from mosaico_ingest.frozen import frozen

__all__ = ["Decoded", "Decoder"]


@frozen
class Decoded:
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
    """Decodes batches of one channel; any bytes give rows or failures, never an exception."""

    @property
    def shape(self) -> pa.StructType:
        """The ROS shape: the type of `Decoded.rows`."""
        ...

    def decode(self, batch: RawBatch) -> Decoded:
        """Decode all messages of the batch."""
        ...
