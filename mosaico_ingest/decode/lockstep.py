"""Locate the values of all messages in lockstep, and choose between this and the other walks.

Elements of a sequence are taken by index: the first of every message, then the second of those that have one.
Where one is as long as that before it, more of that length are guessed, and taken as far as they turn out to be so.
A message whose bytes do not fit is marked and parked at its origin, where reading on is safe; what is noted
about it is dropped at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

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
from mosaico_ingest.decode.spans import (
    Frame,
    Int64s,
    Located,
    Place,
    Places,
    expand,
    join,
)
from mosaico_ingest.decode.walk import Notes, Stepper, locate_clustered, locate_stepwise
from mosaico_ingest.rosbag.blocks import Encoding

__all__ = [
    "FEW",
    "locate",
    "locate_lockstep",
]

FEW = 16
"""So many messages are walked faster one at a time."""
_MANY = 64
"""So many elements of so few messages are worth a look whether they are alike."""
_LOOKS = 3
"""After so many elements a sequence of equal ones shows: the first may be padded otherwise."""
_RARE = 4
"""Messages are guessed at where at least one of so many seems to have equal elements."""
_AHEAD = 8
"""How many elements are guessed at first, and how many times as many after each guess that was right."""


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


@dataclass(slots=True)
class _Elements:
    """The elements of a loop that have been walked, part by part."""

    count: Int64s
    """How many each message has, shape (m,)."""
    parts: list[Places] = field(default_factory=list[Places])
    taken: list[tuple[Int64s, Int64s]] = field(default_factory=list[tuple[Int64s, Int64s]])
    """Of each part, whose elements they are, and which."""
    done: Int64s = field(init=False)
    """How many of each message have been walked, shape (m,)."""

    def __post_init__(self) -> None:
        self.done = np.zeros_like(self.count)

    def left(self, rows: Int64s) -> Int64s:
        return self.count[rows] - self.done[rows]

    def take(self, places: Places, rows: Int64s) -> None:
        """Add the next element of each of some messages."""
        self.note(places, rows, self.done[rows])
        self.done[rows] += 1

    def note(self, places: Places, rows: Int64s, numbers: Int64s) -> None:
        self.parts.append(places)
        self.taken.append((rows, numbers))

    def join(self) -> Places:
        """Return all of them, message by message."""
        firsts = np.cumsum(self.done) - self.done
        return join(self.parts, np.concatenate([firsts[rows] + numbers for rows, numbers in self.taken]))


class _Guesses:
    """What the elements so far say of those to come; shapes (m,)."""

    __slots__ = ("_looks", "_right", "ahead", "alike", "size")

    def __init__(self, messages: int) -> None:
        self.size = np.zeros(messages, np.int64)
        """The bytes of the last element."""
        self.alike = np.zeros(messages, bool)
        """Whether it had as many as that before it."""
        self.ahead = np.full(messages, _AHEAD)
        self._looks = 0
        self._right = False

    def are_worth(self, active: Int64s, walked: _Elements) -> bool:
        """Say whether the next elements are walked together; few messages only where their elements are alike."""
        if len(active) > FEW:
            return True
        promising = self._looks < _LOOKS or self._right
        return promising and int(walked.left(active).sum()) > _MANY

    def note(self, active: Int64s, size: Int64s) -> None:
        self.alike[active] = (size == self.size[active]) & (size > 0)
        self.size[active] = size
        self._looks += 1
        self._right = False

    def judge(self, rows: Int64s, right: NDArray[np.bool_]) -> None:
        self.ahead[rows] = np.where(right, self.ahead[rows] * _AHEAD, _AHEAD)
        self._right = bool(right.any())


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
        walked = _Elements(count)
        active = np.flatnonzero(count > 0)
        guesses = _Guesses(len(count))
        while guesses.are_worth(active, walked):
            begins = cursor.pos[active]
            walked.take(self._element(step.body, cursor, active), active)
            guesses.note(active, cursor.pos[active] - begins)
            active = active[(walked.left(active) > 0) & ~self.broken[cursor.row[active]]]
            alike = active[guesses.alike[active]]
            if len(alike) * _RARE >= len(active):
                self._guess(step.body, cursor, alike, walked, guesses)
                active = active[walked.left(active) > 0]
        active = active[~self.broken[cursor.row[active]]]
        if len(active) or not walked.parts:
            self._rest(step.body, cursor, active, walked)
        return Place(at, walked.done, walked.join())

    def _guess(self, body: Body, cursor: _Cursor, rows: Int64s, walked: _Elements, guesses: _Guesses) -> None:
        """Walk elements of some messages where they begin if each is as long as the last; take those that are."""
        size = guesses.size[rows]
        room = (cursor.end[rows] - cursor.pos[rows]) // size
        width = np.minimum(np.minimum(guesses.ahead[rows], walked.left(rows)), room)
        rows, size, width = (each[width > 0] for each in (rows, size, width))
        if not len(rows):
            return
        number = expand(np.zeros_like(width), width)
        owner, sizes = np.repeat(rows, width), np.repeat(size, width)
        begins = cursor.pos[owner] + number * sizes
        # None may reach into the next: what is walked by mistake is then no more than there are bytes.
        ends = begins + sizes
        frame = self._frame
        origins = cursor.origin[owner]
        trial = _Walk(self._layout, Frame(frame.data, frame.order, origins, ends))
        inner = _Cursor(begins, ends.copy(), origins, np.arange(len(owner)))
        places = trial.body(body, inner)
        fits = (inner.pos == ends) & ~trial.broken
        firsts = np.cumsum(width) - width
        taken = np.minimum.reduceat(np.where(fits, np.repeat(width, width), number), firsts)
        kept = np.flatnonzero(number < np.repeat(taken, width))
        if len(kept) < len(owner):
            places = tuple(place.take(kept) for place in places)
        walked.note(places, owner[kept], walked.done[owner[kept]] + number[kept])
        walked.done[rows] += taken
        cursor.pos[rows] += taken * size
        guesses.judge(rows, taken == width)

    def _element(self, body: Body, cursor: _Cursor, active: Int64s) -> Places:
        """Walk the next element of the active messages."""
        inner = cursor.take(active)
        places = self.body(body, inner)
        cursor.pos[active] = inner.pos
        cursor.end[active] = inner.end
        return places

    def _rest(self, body: Body, cursor: _Cursor, active: Int64s, walked: _Elements) -> None:
        """Walk all elements that are left of the active messages, which are few; take those that fit."""
        stepper, notes = Stepper(self._layout, self._frame), Notes(body)
        before = walked.done[active]
        for index in active.tolist():
            left = int(walked.count[index] - walked.done[index])
            row, pos = int(cursor.row[index]), int(cursor.pos[index])
            fit, end = stepper.elements(row, notes, pos=pos, count=left)
            walked.done[index] += fit
            cursor.pos[index] = end
            if fit < left:
                self._drop(cursor, np.arange(len(walked.count)) == index)
        more = walked.done[active] - before
        walked.note(notes.places(), np.repeat(active, more), expand(before, more))

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


_LARGE_BYTES = 64 << 10
"""So many bytes of few messages may be long sequences, whose elements can be walked together."""


def locate(layout: Layout, frame: Frame) -> Located:
    """Find where everything lies in the messages that fit the layout."""
    if all(isinstance(step, Block) for step in layout.body.steps):
        return locate_lockstep(layout, frame)  # nothing in a message depends on its bytes
    parts = locate_clustered(layout, frame)
    left = np.ones(len(frame), bool)
    for part in parts:
        left[part.rows] = False
    rest = np.flatnonzero(left)
    if len(rest) or not parts:
        others = frame.take(rest)
        is_small = len(rest) <= FEW and int((others.ends - others.origins).sum()) < _LARGE_BYTES
        walk = locate_stepwise if is_small else locate_lockstep
        found = walk(layout, others)
        parts.append(replace(found, rows=rest[found.rows]))
    return _merge(parts)


def _merge(parts: list[Located]) -> Located:
    if len(parts) == 1:
        return parts[0]
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows)
    slots = np.empty(len(rows), np.int64)
    slots[order] = np.arange(len(rows))
    tails = np.concatenate([part.tails for part in parts])
    return Located(rows[order], tails[order], join([part.places for part in parts], slots))
