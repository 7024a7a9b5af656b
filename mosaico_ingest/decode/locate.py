"""Locate the values of many messages together, per group of equal length words, or one message at a time.

Messages of one topic nearly always repeat the lengths of their texts and sequences. If all length words of a message
equal those of a message that has been walked, the *template*, then all its values have the template's offsets.

A layout (`layout.py`) describes a message as a list of steps. For example, a message with an `int32`, a `string` and a
`float64[]` in CDR has the steps

    FixedBlock(4 bytes) → Text → Run(8-byte cells)

*Lockstep* means that all messages take each step together. A cursor holds the position of every message as an array;
each step aligns the positions, reads the length words of all messages with one gather, and advances all positions:

    message   position → after FixedBlock → length word → after Text → length word → after Run
    A         0          4                  3             11           2             32
    B         0          4                  5             13           0             20

The result of each step is a `StepOffsets`: the offset (and count) of its value in every message. `columns.py` copies
all values of a column with one more gather. No step executes Python code per message.

**Loops.** Elements that contain texts or sequences have different sizes, so that the offset of element k is known only
after element k - 1. A loop therefore walks the first element of all messages in lockstep, then the second element of
the messages that have one, and so on. Two strategies handle long loops of few messages:

* *Speculation*: If two consecutive elements of a message have the same size, assume that the following ones do too,
  and walk `ahead` elements at equidistant offsets in one lockstep pass. Keep the longest prefix whose elements really
  have that size. `ahead` grows eightfold with each correct guess.
* *Fallback*: If at most `FEW` messages are active and speculation does not succeed, `MessageWalker` walks the
  remaining elements in plain Python, which is faster for few messages.

**Invalid messages.** A length word that exceeds the remaining bytes marks its message as invalid. The cursor of an
invalid message stays at its origin with no bytes left, where the following steps can read safely; its offsets are
removed at the end. The row-wise decoder reports the error of such a message.

`locate` chooses the method: templates for messages with equal length words, lockstep for many other
messages, and `MessageWalker` for few.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from struct import Struct

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.decode.layout import (
    PADDING,
    WORD,
    ZEROS,
    Body,
    BodyOffsets,
    FixedBlock,
    Int64s,
    Layout,
    LocatedMessages,
    Loop,
    Payloads,
    Run,
    Step,
    StepOffsets,
    Text,
    expand_ranges,
    interleave,
    least_bytes,
)
from mosaico_ingest.rosbag.blocks import Encoding

FEW = 16
"""Maximum number of messages for which walking one at a time is faster than lockstep."""
_MANY_ELEMENTS = 64
"""With at most `FEW` active messages, stay in lockstep only if more than this many elements remain in total."""
_FIRST_ELEMENTS = 3
"""Number of elements after which equal sizes must show; alignment may change the size of the first element."""
_SPECULATION_SHARE = 4
"""Speculate if at least one in this many active messages has two consecutive elements of equal size."""
_AHEAD = 8
"""Number of elements of the first speculation, and growth factor after a correct one."""
_LARGE_BYTES = 64 << 10
"""Minimum total size for lockstep with few messages, because they may contain long loops."""
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
    if (lengths == lengths[0]).all():
        yield np.arange(len(lengths))
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


def locate(layout: Layout, payloads: Payloads) -> LocatedMessages:
    """Return the offsets of all values of the messages that match the layout."""
    if all(isinstance(step, FixedBlock) for step in layout.body.steps):
        return locate_lockstep(layout, payloads)  # all offsets are constant
    parts = locate_by_template(layout, payloads)
    is_remaining = np.ones(len(payloads), bool)
    for part in parts:
        is_remaining[part.rows] = False
    rows = np.flatnonzero(is_remaining)
    if len(rows) or not parts:
        remaining = payloads.take(rows)
        is_small = len(rows) <= FEW and int((remaining.ends - remaining.origins).sum()) < _LARGE_BYTES
        located = (locate_one_by_one if is_small else locate_lockstep)(layout, remaining)
        parts.append(replace(located, rows=rows[located.rows]))
    return _merge(parts)


def _merge(parts: list[LocatedMessages]) -> LocatedMessages:
    if len(parts) == 1:
        return parts[0]
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows)
    slots = np.empty(len(rows), np.int64)
    slots[order] = np.arange(len(rows))
    tails = np.concatenate([part.tails for part in parts])
    offsets = interleave([part.offsets for part in parts], slots)
    return LocatedMessages(rows[order], tails[order], offsets)


def locate_lockstep(layout: Layout, payloads: Payloads) -> LocatedMessages:
    """Walk all messages together."""
    rows = np.flatnonzero(payloads.ends - payloads.origins >= layout.body.least)
    walk = _LockstepWalk(layout, payloads)
    cursor = _Cursor(payloads.origins[rows], payloads.ends[rows], payloads.origins[rows], rows)
    offsets = walk.body(layout.body, cursor)
    located = LocatedMessages(rows, walk.tails(cursor), offsets)
    is_invalid = walk.is_invalid[rows]
    return located.take(np.flatnonzero(~is_invalid)) if is_invalid.any() else located


class _Cursor(msgspec.Struct):
    """The current position in each of m messages; shapes (m,)."""

    pos: Int64s
    end: Int64s
    origin: Int64s
    row: Int64s
    """Index of the message in its `Payloads`."""

    def take(self, index: Int64s) -> _Cursor:
        return _Cursor(self.pos[index], self.end[index], self.origin[index], self.row[index])

    def align(self, align: int) -> None:
        if align > 1:
            self.pos = self.pos + ((self.origin - self.pos) & (align - 1))


@dataclass(slots=True)
class _Elements:
    """The elements of a loop that have been walked, in the order in which they were walked."""

    count: Int64s
    """Number of elements per message, shape (m,)."""
    parts: list[BodyOffsets] = field(default_factory=list[BodyOffsets])
    indices: list[tuple[Int64s, Int64s]] = field(default_factory=list[tuple[Int64s, Int64s]])
    """Message and element number of each instance of each part."""
    done: Int64s = field(init=False)
    """Number of walked elements per message, shape (m,)."""

    def __post_init__(self) -> None:
        self.done = np.zeros_like(self.count)

    def remaining(self, rows: Int64s) -> Int64s:
        return self.count[rows] - self.done[rows]

    def add_next(self, offsets: BodyOffsets, rows: Int64s) -> None:
        """Add the next element of each of some messages."""
        self.add(offsets, rows, self.done[rows])
        self.done[rows] += 1

    def add(self, offsets: BodyOffsets, rows: Int64s, numbers: Int64s) -> None:
        self.parts.append(offsets)
        self.indices.append((rows, numbers))

    def by_message(self) -> BodyOffsets:
        """Return the offsets of all elements, ordered by message."""
        firsts = np.cumsum(self.done) - self.done
        slots = np.concatenate([firsts[rows] + numbers for rows, numbers in self.indices])
        return interleave(self.parts, slots)


class _Speculation:
    """The sizes of previous elements, from which the offsets of the following ones are guessed; shapes (m,)."""

    __slots__ = ("_last_succeeded", "_walked", "ahead", "is_repeated", "size")

    def __init__(self, messages: int) -> None:
        self.size = np.zeros(messages, np.int64)
        """Bytes of the last element."""
        self.is_repeated = np.zeros(messages, bool)
        """Whether the last two elements have the same size."""
        self.ahead = np.full(messages, _AHEAD)
        """Number of elements to guess."""
        self._walked = 0
        self._last_succeeded = False

    def is_lockstep_faster(self, active: Int64s, elements: _Elements) -> bool:
        """Return whether to continue in lockstep: with many messages, or while speculation succeeds."""
        if len(active) > FEW:
            return True
        is_promising = self._walked < _FIRST_ELEMENTS or self._last_succeeded
        return is_promising and int(elements.remaining(active).sum()) > _MANY_ELEMENTS

    def record_sizes(self, active: Int64s, size: Int64s) -> None:
        self.is_repeated[active] = (size == self.size[active]) & (size > 0)
        self.size[active] = size
        self._walked += 1
        self._last_succeeded = False

    def record_result(self, rows: Int64s, is_correct: NDArray[np.bool_]) -> None:
        self.ahead[rows] = np.where(is_correct, self.ahead[rows] * _AHEAD, _AHEAD)
        self._last_succeeded = bool(is_correct.any())


class _LockstepWalk:
    """One pass over all messages."""

    __slots__ = ("_aligned", "_last_word", "_layout", "_payloads", "_words", "is_invalid")

    def __init__(self, layout: Layout, payloads: Payloads) -> None:
        self._layout = layout
        self._payloads = payloads
        self._words = payloads.words()
        self._last_word = len(self._words) - 1
        self._aligned = layout.encoding is Encoding.CDR
        self.is_invalid = np.zeros(len(payloads), bool)

    def body(self, body: Body, cursor: _Cursor) -> BodyOffsets:
        """Walk one instance of a body in each message of the cursor."""
        return tuple(self._step(step, cursor) for step in body.steps)

    def tails(self, cursor: _Cursor) -> Int64s:
        """Return the number of bytes after each message; mark messages with an invalid tail."""
        sizes = cursor.end - cursor.pos
        if not self._aligned:
            self._invalidate(cursor, sizes != 0)
            return sizes
        self._invalidate(cursor, (sizes < 0) | (sizes > ZEROS))
        long_tails = np.flatnonzero((sizes > PADDING) & (sizes <= ZEROS))
        if len(long_tails):
            first = self._words[cursor.pos[long_tails]]
            last = self._words[cursor.end[long_tails] - WORD]
            is_wrong = np.zeros(len(sizes), bool)
            is_wrong[long_tails] = (first != 0) | (last != 0)
            self._invalidate(cursor, is_wrong)
        return sizes

    def _step(self, step: Step, cursor: _Cursor) -> StepOffsets:
        match step:
            case FixedBlock(align=align, size=size):
                cursor.align(align)
                at = cursor.pos
                cursor.pos = at + size
                return StepOffsets(at)
            case Text(unit=unit):
                count = self._read_counts(cursor, step)
                at = cursor.pos
                cursor.pos = at + count * unit
                return StepOffsets(at, count)
            case Run():
                return self._run(step, cursor)
            case Loop():
                return self._loop(step, cursor)

    def _run(self, step: Run, cursor: _Cursor) -> StepOffsets:
        count = self._read_counts(cursor, step, step.bound)
        if step.cell.align > WORD:  # CDR does not align an empty sequence
            unaligned = cursor.pos
            cursor.align(step.cell.align)
            cursor.pos = np.where(count > 0, cursor.pos, unaligned)
        at = cursor.pos
        padding = step.stride - step.cell.size
        cursor.pos = at + (np.maximum(count * step.stride - padding, 0) if padding else count * step.stride)
        return StepOffsets(at, count)

    def _loop(self, step: Loop, cursor: _Cursor) -> StepOffsets:
        if step.count is None:
            count = self._read_counts(cursor, step, step.bound)
        else:
            count = np.full(len(cursor.pos), step.count, np.int64)
        at = cursor.pos
        cursor.pos = at.copy()
        elements = _Elements(count)
        speculation = _Speculation(len(count))
        active = np.flatnonzero(count > 0)
        while speculation.is_lockstep_faster(active, elements):
            starts = cursor.pos[active]
            elements.add_next(self._next_element(step.body, cursor, active), active)
            speculation.record_sizes(active, cursor.pos[active] - starts)
            active = active[(elements.remaining(active) > 0) & ~self.is_invalid[cursor.row[active]]]
            repeated = active[speculation.is_repeated[active]]
            if len(repeated) * _SPECULATION_SHARE >= len(active):
                self._speculate(step.body, cursor, repeated, elements, speculation)
                active = active[elements.remaining(active) > 0]
        active = active[~self.is_invalid[cursor.row[active]]]
        if len(active) or not elements.parts:
            self._walk_remaining(step.body, cursor, active, elements)
        return StepOffsets(at, elements.done, elements.by_message())

    def _next_element(self, body: Body, cursor: _Cursor, active: Int64s) -> BodyOffsets:
        """Walk the next element of the active messages."""
        inner = cursor.take(active)
        offsets = self.body(body, inner)
        cursor.pos[active] = inner.pos
        cursor.end[active] = inner.end
        return offsets

    def _speculate(
        self, body: Body, cursor: _Cursor, rows: Int64s, elements: _Elements, speculation: _Speculation
    ) -> None:
        """Walk elements at equidistant offsets, and keep the prefix of each message whose sizes are correct."""
        size = speculation.size[rows]
        available = (cursor.end[rows] - cursor.pos[rows]) // size
        width = np.minimum(np.minimum(speculation.ahead[rows], elements.remaining(rows)), available)
        rows, size, width = (each[width > 0] for each in (rows, size, width))
        if not len(rows):
            return
        number = expand_ranges(np.zeros_like(width), width)
        owner, sizes = np.repeat(rows, width), np.repeat(size, width)
        starts = cursor.pos[owner] + number * sizes
        # Each guessed element ends where the next one starts, so that wrong guesses cannot walk more bytes than exist.
        ends = starts + sizes
        origins = cursor.origin[owner]
        payloads = Payloads(self._payloads.data, self._payloads.order, origins, ends)
        trial = _LockstepWalk(self._layout, payloads)
        inner = _Cursor(starts, ends.copy(), origins, np.arange(len(owner)))
        offsets = trial.body(body, inner)
        is_correct = (inner.pos == ends) & ~trial.is_invalid
        firsts = np.cumsum(width) - width
        accepted = np.minimum.reduceat(np.where(is_correct, np.repeat(width, width), number), firsts)
        correct = np.flatnonzero(number < np.repeat(accepted, width))
        if len(correct) < len(owner):
            offsets = tuple(step.take(correct) for step in offsets)
        elements.add(offsets, owner[correct], elements.done[owner[correct]] + number[correct])
        elements.done[rows] += accepted
        cursor.pos[rows] += accepted * size
        speculation.record_result(rows, accepted == width)

    def _walk_remaining(self, body: Body, cursor: _Cursor, active: Int64s, elements: _Elements) -> None:
        """Walk all remaining elements of the active messages, which are few, in plain Python."""
        walker, recorder = MessageWalker(self._layout, self._payloads), OffsetRecorder(body)
        before = elements.done[active]
        for index in active.tolist():
            remaining = int(elements.count[index] - elements.done[index])
            row, pos = int(cursor.row[index]), int(cursor.pos[index])
            valid, end = walker.walk_elements(row, recorder, pos=pos, count=remaining)
            elements.done[index] += valid
            cursor.pos[index] = end
            if valid < remaining:
                self._invalidate(cursor, np.arange(len(elements.count)) == index)
        counts = elements.done[active] - before
        elements.add(recorder.offsets(), np.repeat(active, counts), expand_ranges(before, counts))

    def _read_counts(self, cursor: _Cursor, step: Step, bound: int = 0) -> Int64s:
        """Read the length word of each message, and check it against the remaining bytes."""
        if self._aligned:
            cursor.align(WORD)
        # A word beyond the end of its message fails the check below, because fewer than zero bytes remain.
        count = self._words[np.minimum(cursor.pos, self._last_word)].astype(np.int64)
        cursor.pos = cursor.pos + WORD
        is_invalid = count * least_bytes(step) > cursor.end - cursor.pos
        if bound:
            is_invalid |= count > bound
        if is_invalid.any():
            count[is_invalid] = 0
            self._invalidate(cursor, is_invalid)
        return count

    def _invalidate(self, cursor: _Cursor, is_invalid: NDArray[np.bool_]) -> None:
        """Mark messages as invalid and move their cursors to the origin, with no bytes left."""
        if not is_invalid.any():
            return
        self.is_invalid[cursor.row[is_invalid]] = True
        cursor.pos = np.where(is_invalid, cursor.origin, cursor.pos)
        cursor.end = np.where(is_invalid, cursor.origin, cursor.end)
