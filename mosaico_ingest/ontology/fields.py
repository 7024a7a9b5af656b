"""This file is the exact column types a model's annotations may name, where plain Python types are not enough.

```
class Sonar(Serializable):
    beams: list[Float32]                            # list<item: float> not null
    gain: Float32 | None = None                     # float
    rotation: Annotated[list[Float64], FixedSize(9)]  # fixed_size_list<item: double>[9] not null
    payload: Annotated[bytes, pa.large_binary()]    # any Arrow type, taken as it is
```
"""

from __future__ import annotations

from typing import Annotated, Any

import pyarrow as pa
from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from mosaico_ingest.frozen import frozen

__all__ = [
    "FixedSize",
    "Float16",
    "Float32",
    "Float64",
    "Int8",
    "Int16",
    "Int32",
    "Int64",
    "Nullable",
    "UInt8",
    "UInt16",
    "UInt32",
    "UInt64",
]

Int8 = Annotated[int, Field(ge=-(2**7), lt=2**7), pa.int8()]
Int16 = Annotated[int, Field(ge=-(2**15), lt=2**15), pa.int16()]
Int32 = Annotated[int, Field(ge=-(2**31), lt=2**31), pa.int32()]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63), pa.int64()]
UInt8 = Annotated[int, Field(ge=0, lt=2**8), pa.uint8()]
UInt16 = Annotated[int, Field(ge=0, lt=2**16), pa.uint16()]
UInt32 = Annotated[int, Field(ge=0, lt=2**32), pa.uint32()]
UInt64 = Annotated[int, Field(ge=0, lt=2**64), pa.uint64()]
Float16 = Annotated[float, pa.float16()]
Float32 = Annotated[float, pa.float32()]
Float64 = Annotated[float, pa.float64()]


@frozen
class Nullable:
    """Marks a column that may hold nulls although the model wants a value."""


@frozen
class FixedSize:
    """Marks a list of exactly `length` values."""

    length: int

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 - pydantic's signature
        """Check the length after the items."""
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def check(self, values: list[Any]) -> list[Any]:
        """Return `values`, or raise ValueError where they are not `length`."""
        if len(values) != self.length:
            raise ValueError(f"expected {self.length} values, found {len(values)}")
        return values
