"""This file walks all messages at once: one cursor a message, each step taken by all of them together.

Elements of a sequence are taken by index: the first of every message, then the second of those that have one.
A message whose bytes do not fit is marked and parked at its origin, where reading on is safe; what is noted
about it is dropped at the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.decode.layout import (
    PADDING,
    WORD,
    ZEROS,
    Block,
    Body,
    Layout,
    Loop,
    Run,
    Step,
    Text,
    least_bytes,
)
from mosaico_ingest.decode.places import Frame, Int64s, Located, Place, Places, expand, join
from mosaico_ingest.decode.stepwise import Notes, Stepper

__all__ = ["FEW", "locate_lockstep"]

FEW = 16
"""So many messages are walked faster one at a time."""


def locate_lockstep(layout: Layout, frame: Frame) -> Located:
    """Walk all messages of the frame together."""
    whole = np.flatnonzero(frame.ends - frame.origins >= layout.body.least)
    walk = _Walk(layout, frame)
    cursor = _Cursor(frame.origins[whole], frame.ends[whole], frame.origins[whole], whole)
    places = walk.body(layout.body, cursor)
    located = Located(whole, walk.tails(cursor), places)
    broken = walk.broken[whole]
    return located.take(np.flatnonzero(~broken)) if broken.any() else located


@dataclass(slots=True)
class _Cursor:
    """Where each of m messages is; shapes (m,)."""

    pos: Int64s
    end: Int64s
    origin: Int64s
    row: Int64s
    """Its position in the frame."""

    def take(self, index: Int64s) -> _Cursor:
        return _Cursor(self.pos[index], self.end[index], self.origin[index], self.row[index])

    def align(self, align: int) -> None:
        if align > 1:
            self.pos = self.pos + ((self.origin - self.pos) & (align - 1))


class _Walk:
    """One pass over the messages of a frame."""

    __slots__ = ("_aligned", "_frame", "_last", "_layout", "_words", "broken")

    def __init__(self, layout: Layout, frame: Frame) -> None:
        self._layout = layout
        self._frame = frame
        self._words = frame.words()
        self._last = len(self._words) - 1
        self._aligned = layout.encoding is Encoding.CDR
        self.broken = np.zeros(len(frame), bool)

    def body(self, body: Body, cursor: _Cursor) -> Places:
        return tuple(self._step(step, cursor) for step in body.steps)

    def tails(self, cursor: _Cursor) -> Int64s:
        """Return how many bytes are left of each message, which have to be few or none."""
        left = cursor.end - cursor.pos
        if not self._aligned:
            self._drop(cursor, left != 0)
            return left
        self._drop(cursor, (left < 0) | (left > ZEROS))
        more = np.flatnonzero((left > PADDING) & (left <= ZEROS))
        if len(more):
            first, last = self._words[cursor.pos[more]], self._words[cursor.end[more] - WORD]
            wrong = np.zeros(len(left), bool)
            wrong[more] = (first != 0) | (last != 0)
            self._drop(cursor, wrong)
        return left

    def _step(self, step: Step, cursor: _Cursor) -> Place:
        match step:
            case Block(align=align, size=size):
                cursor.align(align)
                at = cursor.pos
                cursor.pos = at + size
                return Place(at)
            case Text(unit=unit):
                count = self._count(cursor, step)
                at = cursor.pos
                cursor.pos = at + count * unit
                return Place(at, count)
            case Run():
                return self._run(step, cursor)
            case Loop():
                return self._loop(step, cursor)

    def _run(self, step: Run, cursor: _Cursor) -> Place:
        count = self._count(cursor, step, step.bound)
        if step.cell.align > WORD:  # an empty run is not aligned
            behind = cursor.pos
            cursor.align(step.cell.align)
            cursor.pos = np.where(count > 0, cursor.pos, behind)
        at = cursor.pos
        padding = step.stride - step.cell.size
        cursor.pos = at + (np.maximum(count * step.stride - padding, 0) if padding else count * step.stride)
        return Place(at, count)

    def _loop(self, step: Loop, cursor: _Cursor) -> Place:
        if step.count is None:
            count = self._count(cursor, step, step.bound)
        else:
            count = np.full(len(cursor.pos), step.count, np.int64)
        at = cursor.pos
        cursor.pos = at.copy()
        done = np.zeros_like(count)
        parts: list[Places] = []
        taken: list[tuple[Int64s, Int64s]] = []
        active = np.flatnonzero(count > 0)
        while len(active) > FEW:
            parts.append(self._element(step.body, cursor, active))
            taken.append((active, done[active]))
            done[active] += 1
            active = active[(done[active] < count[active]) & ~self.broken[cursor.row[active]]]
        active = active[~self.broken[cursor.row[active]]]
        if len(active) or not parts:
            first = done[active]
            parts.append(self._rest(step.body, cursor, active, count, done))
            more = done[active] - first
            taken.append((np.repeat(active, more), expand(first, more)))
        slots = np.concatenate([(np.cumsum(done) - done)[which] + number for which, number in taken])
        return Place(at, done, join(parts, slots))

    def _element(self, body: Body, cursor: _Cursor, active: Int64s) -> Places:
        """Walk the next element of the active messages."""
        inner = cursor.take(active)
        places = self.body(body, inner)
        cursor.pos[active] = inner.pos
        cursor.end[active] = inner.end
        return places

    def _rest(self, body: Body, cursor: _Cursor, active: Int64s, count: Int64s, done: Int64s) -> Places:
        """Walk all elements that are left of the active messages, which are few; `done` counts those that fit."""
        stepper, notes = Stepper(self._layout, self._frame), Notes(body)
        for index in active.tolist():
            left = int(count[index] - done[index])
            row, pos = int(cursor.row[index]), int(cursor.pos[index])
            fit, end = stepper.elements(row, notes, pos=pos, count=left)
            done[index] += fit
            cursor.pos[index] = end
            if fit < left:
                self._drop(cursor, np.arange(len(count)) == index)
        return notes.places()

    def _count(self, cursor: _Cursor, step: Step, bound: int = 0) -> Int64s:
        """Read a length word each, and check it against the bytes left."""
        if self._aligned:
            cursor.align(WORD)
        # A word beyond the message's end is out of bounds below, as less than nothing is left behind it.
        count = self._words[np.minimum(cursor.pos, self._last)].astype(np.int64)
        cursor.pos = cursor.pos + WORD
        over = count * least_bytes(step) > cursor.end - cursor.pos
        if bound:
            over |= count > bound
        if over.any():
            count[over] = 0
            self._drop(cursor, over)
        return count

    def _drop(self, cursor: _Cursor, wrong: NDArray[np.bool_]) -> None:
        """Mark messages as broken and park them at their origin, with no bytes left."""
        if not wrong.any():
            return
        self.broken[cursor.row[wrong]] = True
        cursor.pos = np.where(wrong, cursor.origin, cursor.pos)
        cursor.end = np.where(wrong, cursor.origin, cursor.end)
