"""A message type with a field of every type that an expression can use."""

from __future__ import annotations

import pyarrow as pa


def every_kind(
    *inner: tuple[str, pa.DataType], more: tuple[tuple[str, pa.DataType], ...] = ()
) -> pa.StructType:
    """Return the type; `inner` are additional fields of the nested message, `more` of the message itself."""
    nested = pa.struct([("v", pa.int16()), ("t", pa.string()), ("n", pa.list_(pa.float32())), *inner])
    return pa.struct(
        [
            ("b", pa.bool_()),
            ("i", pa.int8()),
            ("u", pa.uint8()),
            ("k", pa.int64()),
            ("w", pa.uint64()),
            ("f", pa.float32()),
            ("d", pa.float64()),
            ("s", pa.string()),
            ("x", pa.list_(pa.int32())),
            ("y", pa.list_(pa.float64(), 3)),
            ("m", pa.list_(nested)),
            ("p", nested),
            *more,
        ]
    )
