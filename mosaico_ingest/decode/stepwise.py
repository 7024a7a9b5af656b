"""This file walks messages one at a time: for few of them, and for the one a cluster is measured by."""

from __future__ import annotations

from struct import Struct

import numpy as np

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.decode.layout import WORD, Block, Body, Layout, Loop, Run, Step, Text
from mosaico_ingest.decode.places import Frame, Located, Place, Places

__all__ = ["Notes", "Stepper", "locate_stepwise"]

_PADDING = 3
_ZEROS = 7


class _Misfit(Exception):  # noqa: N818 - control flow inside this file, not an error for anyone
    """The bytes do not fit the layout."""


class Notes:
    """The places of a body's steps, as they are found."""

    __slots__ = ("at", "bodies", "counts", "steps")

    def __init__(self, body: Body) -> None:
        self.steps = body.steps
        self.at: list[list[int]] = [[] for _ in body.steps]
        self.counts: list[list[int]] = [[] for _ in body.steps]
        self.bodies = [Notes(step.body) if isinstance(step, Loop) else None for step in body.steps]

    def forget(self, instances: int) -> None:
        """Drop what was found after the first `instances` of the body."""
        for at, counts, body in zip(self.at, self.counts, self.bodies, strict=True):
            del at[instances:]
            del counts[instances:]
            if body is not None:
                body.forget(sum(counts))

    def places(self) -> Places:
        """Return what was found as arrays."""
        return tuple(map(_place, self.steps, self.at, self.counts, self.bodies))


def _place(step: Step, at: list[int], counts: list[int], body: Notes | None) -> Place:
    count = None if isinstance(step, Block) else np.array(counts, np.int64)
    return Place(np.array(at, np.int64), count, body.places() if body else ())


class Stepper:
    """Walks messages of a layout in plain Python."""

    __slots__ = ("_aligned", "_data", "_end", "_frame", "_layout", "_origin", "_word", "nuls", "words")

    def __init__(self, layout: Layout, frame: Frame) -> None:
        self._layout = layout
        self._frame = frame
        self._data = frame.data.data
        self._aligned = layout.encoding is Encoding.CDR
        self._word = Struct(f"{frame.order}I").unpack_from
        self._origin = self._end = 0
        self.words: list[int] = []
        """Where the length words were."""
        self.nuls: list[int] = []
        """Where texts ended in NUL."""

    def message(self, row: int, notes: Notes) -> bool:
        """Walk one message; False, and nothing noted, where it does not fit."""
        self._origin, self._end = int(self._frame.origins[row]), int(self._frame.ends[row])
        done, pos = self._elements(self._layout.body, notes, self._origin, 1)
        if done and self._tail_fits(pos):
            return True
        if done:
            notes.forget(len(notes.at[0]) - 1 if notes.at else 0)
        return False

    def elements(self, row: int, body: Body, notes: Notes, *, pos: int, count: int) -> tuple[int, int]:
        """Walk `count` elements of one message's loop; return how many fit, and the position after them."""
        self._origin, self._end = int(self._frame.origins[row]), int(self._frame.ends[row])
        return self._elements(body, notes, pos, count)

    def _elements(self, body: Body, notes: Notes, pos: int, count: int) -> tuple[int, int]:
        before = len(notes.at[0]) if notes.at else 0
        for done in range(count):
            try:
                pos = self._walk(body, notes, pos)
            except _Misfit:  # noqa: PERF203 - only the first misfit is caught, then the loop ends
                notes.forget(before + done)
                return done, pos
        return count, pos

    def _tail_fits(self, pos: int) -> bool:
        left = self._end - pos
        if not self._aligned:
            return left == 0
        return 0 <= left <= _PADDING or (left <= _ZEROS and not any(self._data[pos : self._end]))

    def _walk(self, body: Body, notes: Notes, pos: int) -> int:
        for step, at, counts, inner in zip(body.steps, notes.at, notes.counts, notes.bodies, strict=True):
            if isinstance(step, Block):
                pos += (self._origin - pos) % step.align
                at.append(pos)
                pos += step.size
            elif isinstance(step, Text):
                pos, count = self._count(pos, step.unit, 0)
                at.append(pos)
                pos += count * step.unit
                counts.append(self._without_nul(step, count, pos))
            elif isinstance(step, Run):
                pos, count = self._count(pos, step.cell.size, step.bound)
                pos += (self._origin - pos) % step.cell.align if count else 0
                at.append(pos)
                counts.append(count)
                pos += (count - 1) * step.stride + step.cell.size if count else 0
            else:
                pos = self._loop(step, at, counts, inner, pos)
        if pos > self._end:
            raise _Misfit
        return pos

    def _loop(self, step: Loop, at: list[int], counts: list[int], notes: Notes | None, pos: int) -> int:
        count = step.count
        if count is None:
            pos, count = self._count(pos, step.body.least, step.bound)
        at.append(pos)
        counts.append(count)
        if notes is not None:
            for _ in range(count):
                pos = self._walk(step.body, notes, pos)
        return pos

    def _count(self, pos: int, least: int, bound: int) -> tuple[int, int]:
        """Read a length word and check it against the bytes left; return the position behind it as well."""
        if self._aligned:
            pos += (self._origin - pos) % WORD
        if pos + WORD > self._end:
            raise _Misfit
        self.words.append(pos)
        count: int = self._word(self._data, pos)[0]
        pos += WORD
        if count * max(least, 1) > self._end - pos or (bound and count > bound):
            raise _Misfit
        return pos, count

    def _without_nul(self, step: Text, count: int, end: int) -> int:
        if not count or step.unit > 1 or not self._aligned:
            return count * step.unit
        self.nuls.append(end - 1)
        if self._data[end - 1]:
            raise _Misfit
        return count - 1


def locate_stepwise(layout: Layout, frame: Frame) -> Located:
    """Walk every message of the frame on its own."""
    stepper, notes = Stepper(layout, frame), Notes(layout.body)
    rows = [row for row in range(len(frame)) if stepper.message(row, notes)]
    return Located(np.array(rows, np.int64), notes.places())
