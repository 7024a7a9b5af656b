"""This file is where pyarrow is taken loosely: its stubs know fewer types and overloads than it has."""

from __future__ import annotations

from typing import Any, TypeAlias

import pyarrow as pa
import pyarrow.compute
import pyarrow.types

__all__ = ["Array", "DataType", "Scalar", "arrays", "pc", "pt"]

Array: TypeAlias = Any
"""A `pyarrow.Array` of whatever type the checker found."""
Scalar: TypeAlias = Any
DataType: TypeAlias = Any
pc: Any = pyarrow.compute
pt: Any = pyarrow.types
arrays: Any = pa
"""pyarrow itself, for the constructors whose stubs are narrower than they are."""
