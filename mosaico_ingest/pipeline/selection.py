"""The rows of a run: the time range, the times of rows, `where` and `on_change`, and latched messages before the range."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.columns import format_type, is_list, pt
from mosaico_ingest.contracts.rows import (
    Evaluator,
    FieldExpression,
    Locate,
    Rows,
    bind_expression,
    locator,
    message_rows,
)
from mosaico_ingest.contracts.values import Values
from mosaico_ingest.decode.decoder import Decoder
from mosaico_ingest.errors import BagError, ManifestError, NothingMatched
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import (
    StampSource,
    TimeBound,
    first_match,
    format_time,
)
from mosaico_ingest.pipeline.plan import Plan, TopicPlan
from mosaico_ingest.rosbag.blocks import Connection, Int64s, MessageBlock
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.recording import Recording

Mask = NDArray[np.bool_]

_SECOND_NS = 1_000_000_000


class RowTimes(Struct, frozen=True):
    """The times of some decoded messages."""

    values: Int64s
    """Nanoseconds since the epoch, shape (n,)."""
    fallback: Mask | None = None
    """Where a message has no selected time, and therefore its log time; None if all messages have it."""


def row_times(
    stamp: StampSource,
    offset_ns: int,
    rows: pa.StructArray,
    log_times: Int64s,
    publish_times: Int64s | None,
) -> RowTimes:
    """Return the times of decoded messages, according to `stamp` and `time_offset`.

    Without `publish_times`, publish times equal the log times.
    """
    times = RowTimes(log_times)
    if stamp is StampSource.PUBLISH and publish_times is not None:
        times = _or_log_times(publish_times, log_times)
    elif stamp is StampSource.HEADER:
        from mosaico_ingest.contracts.rows import stamps_of  # noqa: PLC0415 - only header stamps need it

        times = _or_log_times(stamps_of(rows), log_times)
    if offset_ns:
        return RowTimes(times.values + offset_ns, times.fallback)
    return times


def block_times(block: MessageBlock, decoder: Decoder, stamp: StampSource, offset_ns: int) -> Int64s:
    """Return the time of every message of a block, shape (n,); a message that cannot be decoded has its log time."""
    if stamp is StampSource.LOG:
        return block.log_times + offset_ns
    if stamp is StampSource.PUBLISH:
        no_rows = pa.StructArray.from_arrays([], names=[])
        return row_times(stamp, offset_ns, no_rows, block.log_times, block.publish_times).values
    decoded = decoder.decode(block)
    times = block.log_times + offset_ns
    index = decoded.index
    times[index] = row_times(stamp, offset_ns, decoded.rows, block.log_times[index], None).values
    return times


def _or_log_times(stamps: Int64s | None, log_times: Int64s) -> RowTimes:
    """Return the stamps, and the log time in place of each zero stamp."""
    if stamps is None:
        return RowTimes(log_times, np.ones(len(log_times), bool))
    missing = stamps == 0
    return RowTimes(np.where(missing, log_times, stamps), missing if missing.any() else None)


def row_selector(plan: Plan, topic: TopicPlan) -> RowSelector | None:
    """Return the selector of a topic, or None if it keeps all rows."""
    if plan.selects_after_reading:
        return RowSelector(topic, plan.read_from_ns, plan.read_until_ns)
    return RowSelector(topic) if topic.rate is not None or topic.has_conditions else None


class RowSelector(Struct):
    """Selects the rows of one topic by time range, conditions and rate; its state spans all blocks of the topic."""

    plan: TopicPlan
    start_ns: int | None = None
    """Earlier rows are dropped; None if the reader has applied the time range already."""
    end_ns: int | None = None
    """Rows of this time or later are dropped."""
    _filter: ConditionFilter | None = None
    _origin_ns: int | None = None
    _last_interval: int = -1

    def select(
        self, times: Int64s, rows: pa.StructArray, envelope: Envelope, conditions: Conditions | None
    ) -> tuple[Mask | None, Mapping[str, Mask]]:
        """Return the rows to keep, or None for all of them, and the rows that each rule drops.

        A row counts for the first rule that drops it.
        """
        keep = np.ones(len(times), bool)
        dropped: dict[str, Mask] = {}
        if self.start_ns is not None or self.end_ns is not None:
            start = times.min(initial=0) if self.start_ns is None else self.start_ns
            inside = times >= start if self.end_ns is None else (times >= start) & (times < self.end_ns)
            dropped["time_range"] = keep & ~inside
            keep &= inside
        if conditions is not None:
            if self._filter is None:
                self._filter = ConditionFilter()
            remaining = rows if keep.all() else rows.filter(pa.array(keep))
            where, on_change = (
                _scattered(mask, keep)
                for mask in self._filter.select(conditions, remaining, envelope.take(keep))
            )
            dropped |= {"where": keep & ~where, "on_change": where & ~on_change}
            keep = on_change
        if self.plan.rate is not None:
            selected = _scattered(self._first_of_intervals(times[keep], self.plan.rate), keep)
            dropped["rate"] = keep & ~selected
            keep = selected
        return (None, {}) if keep.all() else (keep, dropped)

    def _first_of_intervals(self, times: Int64s, rate: float) -> Mask:
        """Return the rows whose interval is later than that of every earlier row."""
        if not len(times):
            return np.zeros(0, bool)
        if self._origin_ns is None:
            self._origin_ns = int(times[0])
        intervals = np.floor_divide(times - self._origin_ns, _SECOND_NS / rate).astype(np.int64)
        latest = np.maximum.accumulate(np.concatenate(([self._last_interval], intervals)))
        self._last_interval = int(latest[-1])
        return intervals > latest[:-1]


def _scattered(mask: Mask, rows: Mask) -> Mask:
    """Return a mask over all rows from a mask over some rows."""
    result = np.zeros(len(rows), bool)
    result[rows] = mask
    return result


class Conditions(Struct, frozen=True):
    """The conditions of a topic, bound to one message definition."""

    where: FieldExpression | None
    on_change: tuple[FieldExpression, ...]


def bind_conditions(plan: TopicPlan, definition: Definition) -> Conditions:
    """Return the conditions of a plan that `check_conditions` accepted."""
    rows = _condition_rows(definition)
    where = None if plan.where is None else _bind(plan.where, rows)
    return Conditions(where, tuple(_bind(text, rows) for text in plan.on_change))


def _condition_rows(definition: Definition) -> Rows:
    return replace(message_rows(definition), has_envelope=True)


def _bind(text: str, rows: Rows) -> FieldExpression:
    expression, findings = bind_expression(text, rows, None, locator(None, text))
    if expression is None:
        raise ManifestError(findings[0].message)
    return expression


def check_conditions(job: Job, topics: Iterable[TopicPlan], connections: Sequence[Connection]) -> None:
    """Check the conditions against the message types of the topics that they apply to.

    Raises:
        ManifestError: An expression has a mistake; `findings` has all of them, with their locations.
    """
    by_id = {connection.id: connection for connection in connections}
    findings: dict[Finding, None] = {}
    for topic in topics:
        for path, text in conditions_of(job, topic.topic):
            locate = locator(job.value_span(*path), text)
            for number in topic.connections:
                definition = by_id[number].definition
                if definition is not None:
                    mistakes = condition_findings(path, text, _condition_rows(definition), locate)
                    findings.update(dict.fromkeys(mistakes))
    if findings:
        first, *rest = findings
        more = f" (and {len(rest)} more mistakes)" if rest else ""
        where = str(first.span or "topic_settings")
        raise ManifestError(f"{first.message}{more}", where=where, hint=first.help, findings=tuple(findings))


def conditions_of(job: Job, topic: str) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield the key path and the text of each condition of a topic."""
    for name in ("where", "on_change"):
        globs = (glob for glob, entry in job.topic_settings.items() if name in entry.model_fields_set)
        glob = first_match(globs, topic)
        if glob is None:
            continue
        value = getattr(job.topic_settings[glob], name)
        texts = (
            [((name,), value)]
            if isinstance(value, str)
            else [((name, position), text) for position, text in enumerate(value or ())]
        )
        yield from ((("topic_settings", glob, *keys), text) for keys, text in texts)


def condition_findings(
    path: tuple[str | int, ...], text: str, rows: Rows, locate: Locate
) -> Iterator[Finding]:
    """Yield the mistakes of one condition over messages of a type."""
    expression, mistakes = bind_expression(text, rows, None, locate)
    if expression is None:
        yield from mistakes
        return
    element, span = expression.typed.type.element, locate(0, len(text))
    kind, title = element.arrow, format_type(element)
    if not expression.is_single or is_list(kind):
        hint = "reduce the list to one value, for example with any(…), all(…), max(…) or an index such as [0]"
        message = f"`{text}` has a list of values, not one value per message"
    elif "where" in path and not pt.is_boolean(kind):
        message, hint = f"`{text}` is {title}, not a condition", "compare it with a value, such as `> 0`"
    elif pt.is_nested(kind) or pt.is_binary(kind) or pt.is_null(kind):
        names = f"name a field: {', '.join(member.name for member in kind)}" if pt.is_struct(kind) else None
        message, hint = f"`{text}` is {title}, not a number, text or boolean", names
    else:
        return
    yield Finding("operand-type", Severity.ERROR, message, span, hint)


class ConditionFilter(Struct):
    """Evaluates the conditions of one topic; its state spans all blocks of the topic."""

    _previous: list[Any] = field(default_factory=list[Any])
    """The value of each expression of `on_change` in the latest message that `where` kept; None is null."""

    def select(self, conditions: Conditions, rows: pa.StructArray, envelope: Envelope) -> tuple[Mask, Mask]:
        """Return where `where` is true, and where `on_change` keeps such a message; both have shape (n,)."""
        keep = np.ones(len(rows), bool)
        if conditions.where is not None:
            values = Evaluator(rows, envelope).values(conditions.where)
            keep = values.data.astype(bool)
            if values.null is not None:
                keep = keep & ~values.null
        changed = keep.copy()
        if conditions.on_change and keep.any():
            matches = rows if keep.all() else rows.filter(pa.array(keep))
            evaluator = Evaluator(matches, envelope.take(keep))
            changed[keep] = self._changes(conditions.on_change, evaluator, len(matches))
        return keep, changed

    def _changes(self, expressions: Sequence[FieldExpression], evaluator: Evaluator, count: int) -> Mask:
        """Return where an expression differs from the previous message; the first message of a topic differs."""
        changed = np.zeros(count, bool)
        previous = self._previous
        self._previous = []
        for position, expression in enumerate(expressions):
            values = evaluator.values(expression)
            changed[1:] |= _differs(values)
            first, last = _value(values, 0), _value(values, count - 1)
            changed[0] |= not previous or not _equal(first, previous[position])
            self._previous.append(last)
        return changed


def _differs(values: Values) -> Mask:
    """Return whether each value differs from its predecessor, shape (n - 1,); NaN equals NaN, and null equals null."""
    data = values.data
    differs = data[1:] != data[:-1]
    if data.dtype.kind == "f":
        differs &= ~(np.isnan(data[1:]) & np.isnan(data[:-1]))
    if values.null is None:
        return differs
    before, after = values.null[:-1], values.null[1:]
    return (before != after) | (differs & ~before & ~after)


def _value(values: Values, position: int) -> Any:  # noqa: ANN401 - a number, text, boolean or None
    is_null = values.null is not None and bool(values.null[position])
    return None if is_null else values.data[position]


def _equal(value: Any, other: Any) -> bool:  # noqa: ANN401 - numbers, texts, booleans or None
    if value is None or other is None:
        return value is other
    return bool(value == other) or bool(value != value and other != other)  # noqa: PLR0124 - NaN differs from itself


def is_static(topic: str) -> bool:
    """Return whether all messages of a topic stay valid: each publisher sends its own static transforms."""
    return topic.rpartition("/")[2] == "tf_static"


def latched_blocks(
    plan: Plan, recording: Recording, times_of: Callable[[MessageBlock], Int64s]
) -> Iterator[MessageBlock]:
    """Yield the messages before the time range to include: the latest message of each latched connection, and all static messages.

    The messages of a connection are in log-time order. `times_of` returns the selected times of the messages of a block;
    a message is before the time range if its selected time is.
    """
    static = {
        connection: is_static(topic.topic)
        for topic in plan.topics
        if topic.latched
        for connection in topic.connections
    }
    if plan.read_from_ns is None or not static:
        return
    latest: dict[int, MessageBlock] = {}
    early: dict[int, list[MessageBlock]] = defaultdict(list)
    for block in _early_blocks(plan, recording, static, times_of):
        if static[block.connection]:
            early[block.connection].append(block)
            continue
        last = block.rows(slice(len(block) - 1, None))
        previous = latest.get(block.connection)
        if previous is None or last.log_times[0] >= previous.log_times[0]:
            latest[block.connection] = last
    for connection in static:
        yield from early[connection]
        if connection in latest:
            yield latest[connection]


def _early_blocks(
    plan: Plan, recording: Recording, static: dict[int, bool], times_of: Callable[[MessageBlock], Int64s]
) -> Iterator[MessageBlock]:
    """Yield the messages of some connections before the time range; with an index, at least the latest message of each."""
    if plan.read_from_ns is None or not plan.selects_after_reading:
        yield from _latest_blocks(plan, recording, static)
        return
    for block in recording.message_blocks(tuple(static), memory_bytes=plan.memory.read_bytes):
        is_early = times_of(block) < plan.read_from_ns
        if is_early.any():
            yield block.rows(is_early)


def _latest_blocks(plan: Plan, recording: Recording, static: dict[int, bool]) -> Iterator[MessageBlock]:
    """Yield messages before the log time at which the range starts; the index has the log time of the latest one."""
    single = [connection for connection, is_all in static.items() if not is_all]
    times = recording.index_times(single, end_ns=plan.read_from_ns) if single else {}
    complete = [connection for connection, is_all in static.items() if is_all or times is None]
    for connection, log_times in (times or {}).items():
        if not len(log_times):
            continue
        latest_ns = int(log_times[-1])
        blocks = list(recording.message_blocks((connection,), start_ns=latest_ns, end_ns=latest_ns + 1))
        yield from blocks
        if not blocks:  # the latest message is unreadable
            complete.append(connection)
    if complete:
        yield from recording.message_blocks(
            complete, end_ns=plan.read_from_ns, memory_bytes=plan.memory.read_bytes
        )


def part_range(job: Job, recording: Recording, *, has_log_times: bool) -> tuple[int | None, int | None]:
    """Return the start and end of the part that the job ingests, or else of `bag.time`; see `time_range`."""
    if job.part is not None:
        return job.part.start_ns, job.part.end_ns
    bounds = time_range(job, recording, has_log_times=has_log_times)
    if job.split is not None:
        hint = "correct the times, or remove split to ingest the complete recording"
        where = job.where("split") or str(recording.files[0])
        raise NothingMatched("no part of the recording has messages", where=where, hint=hint)
    return bounds


def time_range(job: Job, recording: Recording, *, has_log_times: bool) -> tuple[int | None, int | None]:
    """Return the start (inclusive) and the end (exclusive) of the time range, ns since the epoch.

    The range must overlap the recording if the times of all rows are log times.

    Raises:
        BagError: The range has an offset, and the recording has no index.
    """

    def instant(bound: TimeBound | None) -> int | None:
        if bound is None or not bound.relative:
            return bound.ns if bound else None
        if recording.start_ns is None or recording.end_ns is None:
            raise BagError(
                "the recording has no index, so its start and end are unknown",
                where=str(recording.files[0]),
                hint="write bag.time as instants instead of offsets",
            )
        return bound.at(recording.start_ns, recording.end_ns)

    start_ns, end_ns = instant(job.bag.time.start), instant(job.bag.time.end)
    if has_log_times:
        _check_time_range(job, recording, start_ns, end_ns)
    return start_ns, end_ns


def missing_publish_times(job: Job, recording: Recording, topics: Iterable[TopicPlan]) -> Iterator[Finding]:
    """Yield a finding for each pattern with `stamp: publish` if the container has no publish times."""
    if recording.container == "mcap":
        return
    stamps = {
        glob: settings.stamp
        for glob, settings in job.topic_settings.items()
        if "stamp" in settings.model_fields_set
    }
    globs = dict.fromkeys(
        glob
        for topic in topics
        if (glob := first_match(stamps, topic.topic)) and topic.stamp is StampSource.PUBLISH
    )
    for glob in globs:
        yield Finding(
            "no-publish-times",
            Severity.WARNING,
            f"stamp: publish has no effect, because {recording.container} recordings contain log times only",
            job.span("topic_settings", glob, "stamp"),
            "set stamp to log or header",
        )


def latched_before(
    job: Job, topics: list[TopicPlan], start_ns: int | None, read_from_ns: int | None
) -> Iterator[Finding]:
    """Yield a finding for each latched topic whose messages before the time range are included or not."""
    if start_ns is None or read_from_ns is None or read_from_ns <= start_ns:
        return
    for topic in topics:
        if topic.latched:
            included = "all of them" if is_static(topic.topic) else "the latest one"
            yield Finding(
                "latched-topic",
                Severity.INFO,
                f"messages of {topic.topic} before the time range are included: {included}",
                job.span("bag", "time", "start"),
            )
        elif is_static(topic.topic):
            yield Finding(
                "static-topic",
                Severity.WARNING,
                f"the messages of {topic.topic} before the time range are not read; most recordings have them"
                " at the start",
                job.span("bag", "time", "include_latched"),
                "remove bag.time.include_latched if the sequence needs these transforms",
            )


def _check_time_range(job: Job, recording: Recording, start_ns: int | None, end_ns: int | None) -> None:
    """Raise NothingMatched if a time range is outside the recording or empty."""
    first_ns, last_ns = recording.start_ns, recording.end_ns
    if first_ns is None or last_ns is None:
        return
    start = first_ns if start_ns is None else max(start_ns, first_ns)
    end = last_ns + 1 if end_ns is None else min(end_ns, last_ns + 1)
    if start < end:
        return
    first, last = format_time(TimeBound(first_ns)), format_time(TimeBound(last_ns))
    message = f"the time range selects nothing of the recording, which lasts from {first} to {last}"
    hint = "change bag.time, or remove it to read the complete recording"
    span = job.span("bag", "time")
    raise NothingMatched(
        message,
        where=job.where("bag", "time") or str(recording.files[0]),
        hint=hint,
        findings=()
        if span is None
        else (Finding("time-range-outside", Severity.ERROR, message, span, hint),),
    )
