"""The header fields of rows: stamps, frames and sequence numbers as columns, and the check of frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.adapters.mapping.columns import Array, arrays, field_of, pc, pt, time_ns
from mosaico_ingest.contracts.values import Batch, Violations, plain_values


@dataclass(slots=True)
class AllowedTexts:
    """Texts that must be in a set, such as frame ids."""

    allowed: tuple[str, ...]
    count: int = 0
    seen: dict[str, None] = field(default_factory=dict[str, None])
    """The first texts that are not allowed."""
    violations: Violations = field(default_factory=Violations)

    def add(self, batch: Batch, texts: Array) -> None:
        """Add the texts of a batch; null counts as an empty text."""
        if not len(texts):
            return
        self.count += len(texts)
        if texts.null_count:
            texts = texts.fill_null("")
        allowed = pc.is_in(texts, value_set=arrays.array(self.allowed, texts.type))
        if allowed.true_count == len(texts):
            return
        bad = ~np.asarray(allowed)
        for text in pc.unique(texts.filter(arrays.array(bad))).slice(0, 5).to_pylist():
            self.seen[text] = None
        self.violations.add(batch, plain_values(texts.to_numpy(zero_copy_only=False)), bad)


def stamps_of(rows: Array) -> NDArray[np.int64] | None:
    """Return the header stamps of messages in nanoseconds, shape (n,), 0 for null; None without a header stamp."""
    return _times(_member(rows, "header", "stamp"), ("sec", "nanosec"))


def ontology_stamps_of(rows: Array) -> NDArray[np.int64] | None:
    """Return the header stamps of stored rows in nanoseconds, shape (n,), 0 for null; None without a header."""
    return _times(_member(rows, "header", "timestamp"), ("seconds", "nanoseconds"))


def frames_of(rows: Array) -> Array | None:
    """Return the frame ids as an Arrow array; None if the rows have no header with a frame."""
    return _member(rows, "header", "frame_id")


def header_numbers_of(rows: Array) -> NDArray[np.int64] | None:
    """Return `header.seq` of ROS 1, shape (n,); None if the rows have none."""
    numbers = _member(rows, "header", "seq")
    return None if numbers is None else _numbers(numbers).astype(np.int64)


def _member(rows: Array, *names: str) -> Array | None:
    for name in names:
        if not pt.is_struct(rows.type) or rows.type.get_field_index(name) < 0:
            return None
        rows = field_of(rows, name)
    return rows


def _times(times: Array | None, parts: tuple[str, str]) -> NDArray[np.int64] | None:
    if times is None or any(_member(times, part) is None for part in parts):
        return None
    return _numbers(time_ns(times, parts))


def _numbers(array: Array) -> NDArray[Any]:
    return np.asarray(array.fill_null(0) if array.null_count else array)
