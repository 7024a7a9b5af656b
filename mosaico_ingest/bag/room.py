"""This file gives room for many bytes, without the price of pages the system has to clear first."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

__all__ = ["room"]


def room(size: int) -> NDArray[np.uint8]:
    """Return `size` bytes of no known value from Arrow's pool, which gives out again what was freed.

    Those of `numpy.empty` are new pages every time, and to touch them takes longer than to copy a picture into them.
    """
    return np.frombuffer(memoryview(pa.allocate_buffer(size)), np.uint8)
