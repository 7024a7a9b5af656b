"""Locate the values of messages one message at a time, or one message per cluster of equal layouts.

Messages of one topic nearly always repeat the lengths of their texts and sequences. Where all length words of a
message have the values of the one that was walked, everything in it lies where it lies there.
"""

from __future__ import annotations

from collections.abc import Iterator
from struct import Struct

import numpy as np
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
)
from mosaico_ingest.rosbag.blocks import Encoding

__all__ = [
    "Notes",
    "Stepper",
    "locate_clustered",
    "locate_stepwise",
]


class _Misfit(Exception):  # noqa: N818 - control flow inside this file, not an error for anyone
    """The bytes do not fit the layout."""


class _Track:
    """The places of one step, as they are found."""

    __slots__ = ("at", "body", "counts", "fixed", "least", "step")

    def __init__(self, step: Step) -> None:
        self.step = step
        self.at: list[int] = []
        self.counts: list[int] = []
        self.body = Notes(step.body) if isinstance(step, Loop) else None
        self.fixed = step.count if isinstance(step, Loop) else None
        self.least = least_bytes(step)

    def place(self) -> Place:
        count = None if isinstance(self.step, Block) else np.array(self.counts, np.int64)
        return Place(np.array(self.at, np.int64), count, () if self.body is None else self.body.places())


class Notes:
    """The places of a body's steps, as they are found."""

    __slots__ = ("tracks",)

    def __init__(self, body: Body) -> None:
        self.tracks = [_Track(step) for step in body.steps]

    def __len__(self) -> int:
        """Return the number of instances."""
        return len(self.tracks[0].at) if self.tracks else 0

    def forget(self, instances: int) -> None:
        """Drop what was found after the first `instances` of the body."""
        for track in self.tracks:
            del track.at[instances:]
            del track.counts[instances:]
            if track.body is not None:
                track.body.forget(sum(track.counts))

    def places(self) -> Places:
        """Return what was found as arrays."""
        return tuple(track.place() for track in self.tracks)


class Stepper:
    """Walks messages of a layout in plain Python."""

    __slots__ = ("_aligned", "_data", "_end", "_frame", "_layout", "_origin", "_word", "words")

    def __init__(self, layout: Layout, frame: Frame) -> None:
        self._layout = layout
        self._frame = frame
        self._data = frame.data.data
        self._aligned = layout.encoding is Encoding.CDR
        self._word = Struct(f"{frame.order}I").unpack_from
        self._origin = self._end = 0
        self.words: list[int] = []
        """Where the words were that the walk depended on: lengths, and zeros behind the message."""

    def message(self, row: int, notes: Notes) -> int | None:
        """Walk one message and return how many bytes follow it; None, and nothing noted, where it does not fit."""
        before = len(notes)
        fit, pos = self.elements(row, notes, pos=int(self._frame.origins[row]), count=1)
        if fit and self._tail_fits(pos):
            return self._end - pos
        notes.forget(before)
        return None

    def elements(self, row: int, notes: Notes, *, pos: int, count: int) -> tuple[int, int]:
        """Walk `count` elements of one message's loop; return how many fit, and the position after them."""
        self._origin, self._end = int(self._frame.origins[row]), int(self._frame.ends[row])
        before = len(notes)
        for done in range(count):
            try:
                pos = self._walk(notes, pos)
            except _Misfit:  # noqa: PERF203 - only the first misfit is caught, then the loop ends
                notes.forget(before + done)
                return done, pos
        return count, pos

    def _tail_fits(self, pos: int) -> bool:
        left = self._end - pos
        if not self._aligned or left <= PADDING:
            return left == 0 or (self._aligned and left >= 0)
        self.words += [pos, self._end - WORD]  # between them they cover the tail: where they agree, it does
        return left <= ZEROS and not any(self._data[pos : self._end])

    def _walk(self, notes: Notes, pos: int) -> int:
        """Walk one instance of a body, and return the position behind it."""
        for track in notes.tracks:
            step = track.step
            if isinstance(step, Block):
                pos += (self._origin - pos) % step.align
                track.at.append(pos)
                pos += step.size
                continue
            count = track.fixed
            if count is None:
                pos, count = self._count(pos, track.least)
            if isinstance(step, Text):
                track.at.append(pos)
                track.counts.append(count)
                pos += count * step.unit
            else:
                pos = self._elements(track, step, pos, count)
        if pos > self._end:
            raise _Misfit
        return pos

    def _elements(self, track: _Track, step: Run | Loop, pos: int, count: int) -> int:
        if step.bound and count > step.bound:
            raise _Misfit
        if isinstance(step, Run) and count:
            pos += (self._origin - pos) % step.cell.align
        track.at.append(pos)
        track.counts.append(count)
        if isinstance(step, Run):
            return pos + (count - 1) * step.stride + step.cell.size if count else pos
        if track.body is not None:
            for _ in range(count):
                pos = self._walk(track.body, pos)
        return pos

    def _count(self, pos: int, least: int) -> tuple[int, int]:
        """Read a length word and check it against the bytes left; return the position behind it as well."""
        if self._aligned:
            pos += (self._origin - pos) % WORD
        self.words.append(pos)
        behind = pos + WORD
        if behind > self._end:
            raise _Misfit
        count: int = self._word(self._data, pos)[0]
        if count * least > self._end - behind:
            raise _Misfit
        return behind, count


def locate_stepwise(layout: Layout, frame: Frame) -> Located:
    """Walk every message of the frame on its own."""
    stepper, notes = Stepper(layout, frame), Notes(layout.body)
    tails = {row: tail for row in range(len(frame)) if (tail := stepper.message(row, notes)) is not None}
    rows = np.fromiter(tails, np.int64, len(tails))
    return Located(rows, np.fromiter(tails.values(), np.int64, len(tails)), notes.places())


_SMALLEST = 4
"""Messages a cluster has at least."""

_CLUSTER_NS, _CHECK_NS = 120_000, 10
_STEP_NS = 1_200
_TOGETHER_NS, _LOCKSTEP_NS = 15_000, 60
"""What things cost: a cluster in itself, and each length word of a message that is checked; a word that is walked
stepwise; a word of all messages in lockstep, and of each. Measured once; only their ratios matter."""


def locate_clustered(layout: Layout, frame: Frame) -> list[Located]:
    """Return the clusters that pay; messages in none of them are left to another way of walking."""
    groups = list(_same_length(frame.ends - frame.origins))
    if not groups:
        return []
    words = len(_Sample(layout, frame, int(groups[0][0])).words)
    members = sum(map(len, groups))
    clustered = len(groups) * (_CLUSTER_NS + words * _STEP_NS) + members * words * _CHECK_NS
    if clustered > words * min(members * _STEP_NS, _TOGETHER_NS + members * _LOCKSTEP_NS):
        return []
    return [cluster for rows in groups for cluster in _split(layout, frame, rows)]


def _same_length(lengths: Int64s) -> Iterator[Int64s]:
    """Yield the positions of each length that is frequent enough."""
    if len(lengths) < _SMALLEST:
        return
    order = np.argsort(lengths, kind="stable")
    borders = np.flatnonzero(np.diff(lengths[order], prepend=-1, append=-1))
    for group in np.flatnonzero(np.diff(borders) >= _SMALLEST).tolist():
        yield order[borders[group] : borders[group + 1]]


def _split(layout: Layout, frame: Frame, rows: Int64s) -> Iterator[Located]:
    """Yield the clusters within messages of one length, as long as each takes a good part of the rest."""
    while len(rows) >= _SMALLEST:
        sample = _Sample(layout, frame, int(rows[0]))
        alike = sample.compare(frame.take(rows))
        members = rows[alike]
        if len(members):
            yield sample.spread(frame, members)
        if len(members) * 4 < len(rows):
            return
        rows = rows[~alike]


class _Sample:
    """One message that was walked."""

    __slots__ = ("_frame", "_places", "_tail", "words")

    def __init__(self, layout: Layout, frame: Frame, row: int) -> None:
        stepper, notes = Stepper(layout, frame), Notes(layout.body)
        self._frame = frame.take(np.array([row]))
        self._tail = stepper.message(row, notes)
        self.words = np.array(stepper.words, np.int64) - frame.origins[row]
        self._places = notes.places()

    def compare(self, frame: Frame) -> NDArray[np.bool_]:
        """Return which messages, all of the sample's length, have the words its walk depended on."""
        if self._tail is None:
            return np.zeros(len(frame), bool)
        words = frame.words()
        expected = words[self._frame.origins + self.words]
        found = words[frame.origins[:, None] + self.words]
        return (found == expected).all(axis=1)

    def spread(self, frame: Frame, rows: Int64s) -> Located:
        """Return the messages that compared equal, laid out like the sample."""
        moved = frame.origins[rows] - self._frame.origins
        tails = np.full(len(rows), self._tail or 0)
        return Located(rows, tails, tuple(place.spread(moved) for place in self._places))
