"""Locate values one message at a time, or once per group of messages with equal length words.

Messages of one topic nearly always repeat the lengths of their texts and sequences. If all length words of a message
equal those of a message that has been walked, the *template*, then all its values have the template's offsets.
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
    Body,
    FixedBlock,
    Layout,
    Loop,
    Run,
    Step,
    Text,
    least_bytes,
)
from mosaico_ingest.decode.spans import BodyOffsets, Int64s, LocatedMessages, Payloads, StepOffsets
from mosaico_ingest.rosbag.blocks import Encoding

_MIN_GROUP = 4
"""Minimum number of messages per template."""
_TEMPLATE_NS, _CHECK_NS = 120_000, 10
_WALK_NS = 1_200
_LOCKSTEP_NS, _LOCKSTEP_MESSAGE_NS = 15_000, 60
"""Measured costs, of which only the ratios matter: per template, per comparison of a length word, per length word
walked in Python, and per length word in lockstep plus per message."""


class _InvalidMessage(Exception):  # noqa: N818 - control flow inside this module
    """The bytes do not match the layout."""


class _StepRecorder:
    """Collects the offsets of one step."""

    __slots__ = ("at", "body", "counts", "fixed_count", "least", "step")

    def __init__(self, step: Step) -> None:
        self.step = step
        self.at: list[int] = []
        self.counts: list[int] = []
        self.body = OffsetRecorder(step.body) if isinstance(step, Loop) else None
        self.fixed_count = step.count if isinstance(step, Loop) else None
        self.least = least_bytes(step)

    def offsets(self) -> StepOffsets:
        count = None if isinstance(self.step, FixedBlock) else np.array(self.counts, np.int64)
        return StepOffsets(
            np.array(self.at, np.int64), count, () if self.body is None else self.body.offsets()
        )


class OffsetRecorder:
    """Collects the offsets of a body's steps."""

    __slots__ = ("steps",)

    def __init__(self, body: Body) -> None:
        self.steps = [_StepRecorder(step) for step in body.steps]

    def __len__(self) -> int:
        """Return the number of instances."""
        return len(self.steps[0].at) if self.steps else 0

    def truncate(self, instances: int) -> None:
        """Remove all offsets after the first `instances` of the body."""
        for step in self.steps:
            del step.at[instances:]
            del step.counts[instances:]
            if step.body is not None:
                step.body.truncate(sum(step.counts))

    def offsets(self) -> BodyOffsets:
        """Return the offsets as arrays."""
        return tuple(step.offsets() for step in self.steps)


class MessageWalker:
    """Walks messages of one layout in plain Python."""

    __slots__ = ("_aligned", "_data", "_end", "_layout", "_origin", "_payloads", "_word", "words")

    def __init__(self, layout: Layout, payloads: Payloads) -> None:
        self._layout = layout
        self._payloads = payloads
        self._data = payloads.data.data
        self._aligned = layout.encoding is Encoding.CDR
        self._word = Struct(f"{payloads.order}I").unpack_from
        self._origin = self._end = 0
        self.words: list[int] = []
        """Offsets of the words that determine the result: length words, and zeros after the message."""

    def walk_message(self, row: int, recorder: OffsetRecorder) -> int | None:
        """Record the offsets of one message and return the number of bytes after it; None if it is invalid."""
        before = len(recorder)
        valid, pos = self.walk_elements(row, recorder, pos=int(self._payloads.origins[row]), count=1)
        if valid and self._is_tail_valid(pos):
            return self._end - pos
        recorder.truncate(before)
        return None

    def walk_elements(self, row: int, recorder: OffsetRecorder, *, pos: int, count: int) -> tuple[int, int]:
        """Record up to `count` elements of a message's loop; return the number of valid ones and the position after."""
        self._origin, self._end = int(self._payloads.origins[row]), int(self._payloads.ends[row])
        before = len(recorder)
        for count_done in range(count):
            try:
                pos = self._walk_body(recorder, pos)
            except _InvalidMessage:  # noqa: PERF203 - ends the loop
                recorder.truncate(before + count_done)
                return count_done, pos
        return count, pos

    def _is_tail_valid(self, pos: int) -> bool:
        size = self._end - pos
        if not self._aligned or size <= PADDING:
            return size == 0 or (self._aligned and size >= 0)
        self.words += [pos, self._end - WORD]  # these two words cover all bytes of the tail
        return size <= ZEROS and not any(self._data[pos : self._end])

    def _walk_body(self, recorder: OffsetRecorder, pos: int) -> int:
        """Record one instance of a body, and return the position after it."""
        for recorded in recorder.steps:
            step = recorded.step
            if isinstance(step, FixedBlock):
                pos += (self._origin - pos) % step.align
                recorded.at.append(pos)
                pos += step.size
                continue
            count = recorded.fixed_count
            if count is None:
                pos, count = self._read_count(pos, recorded.least)
            if isinstance(step, Text):
                recorded.at.append(pos)
                recorded.counts.append(count)
                pos += count * step.unit
            else:
                pos = self._walk_sequence(recorded, step, pos, count)
        if pos > self._end:
            raise _InvalidMessage
        return pos

    def _walk_sequence(self, recorded: _StepRecorder, step: Run | Loop, pos: int, count: int) -> int:
        if step.bound and count > step.bound:
            raise _InvalidMessage
        if isinstance(step, Run) and count:
            pos += (self._origin - pos) % step.cell.align
        recorded.at.append(pos)
        recorded.counts.append(count)
        if isinstance(step, Run):
            return pos + (count - 1) * step.stride + step.cell.size if count else pos
        if recorded.body is not None:
            for _ in range(count):
                pos = self._walk_body(recorded.body, pos)
        return pos

    def _read_count(self, pos: int, least: int) -> tuple[int, int]:
        """Read a length word and check it against the remaining bytes; return the position after it and the count."""
        if self._aligned:
            pos += (self._origin - pos) % WORD
        self.words.append(pos)
        after = pos + WORD
        if after > self._end:
            raise _InvalidMessage
        count: int = self._word(self._data, pos)[0]
        if count * least > self._end - after:
            raise _InvalidMessage
        return after, count


def locate_one_by_one(layout: Layout, payloads: Payloads) -> LocatedMessages:
    """Walk each message individually."""
    walker, recorder = MessageWalker(layout, payloads), OffsetRecorder(layout.body)
    tails = {
        row: tail for row in range(len(payloads)) if (tail := walker.walk_message(row, recorder)) is not None
    }
    rows = np.fromiter(tails, np.int64, len(tails))
    return LocatedMessages(rows, np.fromiter(tails.values(), np.int64, len(tails)), recorder.offsets())


def locate_by_template(layout: Layout, payloads: Payloads) -> list[LocatedMessages]:
    """Return the groups of messages for which a template is the cheapest method; omit all other messages."""
    groups = list(_same_length(payloads.ends - payloads.origins))
    if not groups:
        return []
    words = len(_Template(layout, payloads, int(groups[0][0])).words)
    members = sum(map(len, groups))
    template_ns = len(groups) * (_TEMPLATE_NS + words * _WALK_NS) + members * words * _CHECK_NS
    if template_ns > words * min(members * _WALK_NS, _LOCKSTEP_NS + members * _LOCKSTEP_MESSAGE_NS):
        return []
    return [located for rows in groups for located in _match_templates(layout, payloads, rows)]


def _same_length(lengths: Int64s) -> Iterator[Int64s]:
    """Yield the rows of each length that occurs at least `_MIN_GROUP` times."""
    if len(lengths) < _MIN_GROUP:
        return
    order = np.argsort(lengths, kind="stable")
    borders = np.flatnonzero(np.diff(lengths[order], prepend=-1, append=-1))
    for group in np.flatnonzero(np.diff(borders) >= _MIN_GROUP).tolist():
        yield order[borders[group] : borders[group + 1]]


def _match_templates(layout: Layout, payloads: Payloads, rows: Int64s) -> Iterator[LocatedMessages]:
    """Yield groups of equal layout among messages of one length, while each matches a quarter of the remainder."""
    while len(rows) >= _MIN_GROUP:
        template = _Template(layout, payloads, int(rows[0]))
        matches = template.matches(payloads.take(rows))
        members = rows[matches]
        if len(members):
            yield template.locate(payloads, members)
        if len(members) * 4 < len(rows):
            return
        rows = rows[~matches]


class _Template:
    """One walked message, whose offsets apply to all messages with the same length words."""

    __slots__ = ("_offsets", "_payloads", "_tail", "words")

    def __init__(self, layout: Layout, payloads: Payloads, row: int) -> None:
        walker, recorder = MessageWalker(layout, payloads), OffsetRecorder(layout.body)
        self._payloads = payloads.take(np.array([row]))
        self._tail = walker.walk_message(row, recorder)
        self.words = np.array(walker.words, np.int64) - payloads.origins[row]
        self._offsets = recorder.offsets()

    def matches(self, payloads: Payloads) -> NDArray[np.bool_]:
        """Return which messages, all of the template's length, have the same words at the offsets in `words`."""
        if self._tail is None:
            return np.zeros(len(payloads), bool)
        words = payloads.words()
        expected = words[self._payloads.origins + self.words]
        return (words[payloads.origins[:, None] + self.words] == expected).all(axis=1)

    def locate(self, payloads: Payloads, rows: Int64s) -> LocatedMessages:
        """Return the offsets of messages that match."""
        distances = payloads.origins[rows] - self._payloads.origins
        tails = np.full(len(rows), self._tail or 0)
        return LocatedMessages(rows, tails, tuple(step.repeat_at(distances) for step in self._offsets))
