"""This file finds messages that are laid out alike: one of them is walked, the others are only checked.

Messages of one topic nearly always repeat the lengths of their texts and sequences. Where all length words of a
message have the values of the one that was walked, everything in it lies where it lies there.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mosaico_ingest.decode.layout import Layout
from mosaico_ingest.decode.places import Frame, Int64s, Located
from mosaico_ingest.decode.stepwise import Notes, Stepper

__all__ = ["locate_clustered"]

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
