"""This file holds where things lie in a buffer: messages before they are walked, values after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.frozen import frozen

__all__ = ["Frame", "Int64s", "Located", "Place", "Places", "expand", "join"]

Int64s: TypeAlias = NDArray[np.int64]


@frozen
class Frame:
    """n messages of one byte order in a buffer; alignment counts from `origins`, shapes (n,)."""

    data: NDArray[np.uint8]
    order: str
    """`<` or `>`, as numpy and struct spell it."""
    origins: Int64s
    ends: Int64s

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.origins)

    def take(self, rows: Int64s) -> Frame:
        """Return some of the messages."""
        return Frame(self.data, self.order, self.origins[rows], self.ends[rows])

    def words(self) -> NDArray[np.uint32]:
        """Return the length word that begins at each byte of the buffer, without copying it."""
        count = max(len(self.data) - 3, 0)
        return np.ndarray((count,), f"{self.order}u4", self.data.data, 0, (1,))


@frozen
class Place:
    """Where one step lies in each of m instances of its body, in the order of the messages."""

    at: Int64s
    """The first byte, shape (m,)."""
    count: Int64s | None = None
    """Bytes of a text, elements of a run or loop, shape (m,); None for a block."""
    body: Places = ()
    """The steps of a loop's elements, one instance each, sum(count) in all."""

    @property
    def counts(self) -> Int64s:
        """The counts of a text, run or loop."""
        return np.zeros_like(self.at) if self.count is None else self.count

    def take(self, index: Int64s) -> Place:
        """Return the place in the instances of `index`, in that order."""
        count = None if self.count is None else self.count[index]
        if self.count is None or count is None or not self.body:
            return Place(self.at[index], count)
        firsts = np.cumsum(self.count) - self.count
        inner = expand(firsts[index], count)
        return Place(self.at[index], count, tuple(place.take(inner) for place in self.body))

    def spread(self, origins: Int64s) -> Place:
        """Return the place of a message whose origin is 0 in messages that are laid out like it."""
        at = (origins[:, None] + self.at).ravel()
        count = None if self.count is None else np.tile(self.count, len(origins))
        return Place(at, count, tuple(place.spread(origins) for place in self.body))


Places: TypeAlias = tuple[Place, ...]
"""One for each step of a body."""


@frozen
class Located:
    """The n messages that fit the layout, and where their steps lie."""

    rows: Int64s
    """Their positions in the frame, ascending, shape (n,)."""
    tails: Int64s
    """How many bytes follow what the layout describes, shape (n,)."""
    places: Places

    def take(self, index: Int64s) -> Located:
        """Return some of the messages; `index` ascends."""
        return Located(self.rows[index], self.tails[index], tuple(place.take(index) for place in self.places))


def expand(firsts: Int64s, counts: Int64s, stride: int = 1) -> Int64s:
    """Return `firsts[i] + j * stride` for each i and each j below `counts[i]`."""
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(firsts - (ends - counts) * stride, counts) + np.arange(total) * stride


def join(parts: Sequence[Places], slots: Int64s) -> Places:
    """Put the instances of all parts, one part behind the other, into the order of their `slots`, which are 0 to m-1."""
    order = np.empty(len(slots), np.int64)
    order[slots] = np.arange(len(slots))
    return tuple(_concatenate(pieces).take(order) for pieces in zip(*parts, strict=True))


def _concatenate(pieces: tuple[Place, ...]) -> Place:
    at = np.concatenate([piece.at for piece in pieces])
    counts = [piece.count for piece in pieces if piece.count is not None]
    bodies = zip(*(piece.body for piece in pieces), strict=True)
    return Place(at, np.concatenate(counts) if counts else None, tuple(map(_concatenate, bodies)))
