"""This file decodes one message after the other: slow, and what the columnar decoder is compared with."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.bag.batch import Encoding, RawBatch
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.deserialize import Deserializer
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.decode.decoder import Decoded
from mosaico_ingest.diagnostics import RowFailure
from mosaico_ingest.errors import DecodeError

__all__ = ["RowwiseDecoder"]


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

    def decode(self, batch: RawBatch) -> Decoded:
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
