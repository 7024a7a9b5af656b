"""A draft of the section `expect`, derived from good recordings: their values and message fields with a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_FLOOR, Decimal
from enum import Enum
from glob import escape

import numpy as np
import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.mapping.columns import is_number
from mosaico_ingest.contracts import duration_text, number_text
from mosaico_ingest.contracts.monitor import TopicMonitor
from mosaico_ingest.contracts.rows import Evaluator, FieldExpression, bind_expression, message_rows
from mosaico_ingest.contracts.values import Values
from mosaico_ingest.decode.decoder import decoder_for
from mosaico_ingest.display import counted, mean_rate_hz
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.reference import plain
from mosaico_ingest.job.values import Stores
from mosaico_ingest.pipeline.contract import monitor_of
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.task import Task, open_job
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.report.parts import ContractResult, Outcome
from mosaico_ingest.rosbag.blocks import Connection
from mosaico_ingest.rosbag.definitions.model import Definition, Language

DEFAULT_TOLERANCE = 20.0
"""Percentage by which the range of the recordings' values is widened."""

_FEW_MESSAGES = 10
"""Topics with fewer messages have no meaningful rate."""
_REGULAR_GAP = 10
"""The longest gap of a regular topic, in mean periods; the rate of other topics is not limited."""
_MAX_FRAMES = 4
_NO_FRAME = "\x00"
"""A frame id that no message has, so that the probe collects all of them."""
_UNIT_NORM = (0.99, 1.01)
"""The limits of the norm of quaternions that are rotations."""
_MAX_LIMIT = 1e15
"""Larger numbers are not limited."""
_DIGITS = 3
_COMMENT_COLUMN = 60
_UNITS = ((60_000_000_000, "min"), (1_000_000_000, "s"), (1_000_000, "ms"), (1_000, "us"), (1, "ns"))
_LONG_NS = 600_000_000_000
"""Durations below ten minutes are written in seconds or smaller units."""
_PROBE = {
    "on_failure": "warn",
    "recording": {"unreadable": "0", "chunk_crcs": {"present": True, "valid": True}, "metadata_counts": {}},
    "topics": {
        "*": {
            "gap": {"max": "100000 d"},
            "latency": {"max": "100000 d", "min": "-100000 d"},
            "stamps": ["monotonic", "unique"],
            "frame_id": [_NO_FRAME],
            "out_of_order": "0",
            "sequence_numbers": {"missing": "0"},
        }
    },
}
"""A contract whose evaluation measures everything that a draft limits."""


MAX_FIELDS = 8
"""Maximum number of expressions per topic, in the order of the message definition."""
_VECTORS = ({"x", "y"}, {"x", "y", "z"})
_QUATERNION = {"x", "y", "z", "w"}
_TIMES = ({"sec", "nanosec"}, {"seconds", "nanos"})
"""The fields of times and durations, which are not measured."""
_GEOGRAPHIC = frozenset({"position", "latitude", "longitude", "altitude"})
"""The names of fields that depend on where a recording is made, so that their range is never stable."""
_STABLE_SHARE = 0.25
"""Maximum distance between the limits of both halves of a recording, as a share of the range of all values."""
_MAX_TEXT = 64
"""Maximum length of a text that can be expected."""


class MeasuredTopic(Struct, frozen=True):
    """The values of one topic in one recording; None for a value that it does not have."""

    msgtype: str
    count: int
    rate_hz: float | None
    gap_ns: int | None
    latency_ns: tuple[int, int] | None
    """The smallest and the largest latency."""
    frames: frozenset[str]
    stamps: frozenset[str]
    """The properties that the header stamps have: `monotonic`, `unique`."""
    fulfilled: frozenset[str]
    """The keys of further expectations that the topic fulfills."""
    fields: Mapping[str, MeasuredField] = {}
    """The values of message fields, by expression."""

    @property
    def is_regular(self) -> bool:
        """Whether messages come at a regular rate."""
        if self.rate_hz is None or self.gap_ns is None or self.count < _FEW_MESSAGES:
            return False
        return self.gap_ns * self.rate_hz <= _REGULAR_GAP * 1e9


class MeasuredRecording(Struct, frozen=True):
    """The values of one recording."""

    topics: Mapping[str, MeasuredTopic]
    """The topics with messages, by name."""
    duration_ns: int
    fulfilled: frozenset[str]
    """The keys of the expectations of the recording that it fulfills."""


def measure_recording(path: AnyPath, *, ros_distro: Stores | str | None = None) -> MeasuredRecording:
    """Read a recording and return the values that expectations limit.

    Raises:
        IngestError: The recording cannot be read.
    """
    job = ROSInjectionConfig(
        file_path=path, sequence_name="draft", ros_distro=ros_distro, manifest={"expect": _PROBE}
    ).job
    with open_job(job) as (recording, resolver):
        plan = plan_recording(Task(job), recording, bridge=ROSBridge.for_job(job), resolver=resolver)
        monitor = monitor_of(plan, recording)
        if monitor is None:
            raise AssertionError("the probe has expectations")
        connections = [
            recording.connections[connection]
            for topic in plan.read_topics
            for connection in topic.connections
        ]
        order = monitor.order
        blocks = recording.message_blocks(
            [connection.id for connection in connections], observe=None if order is None else order.add
        )
        observers = {one.id: monitor.observer(one.id) for one in connections}
        start_ns, end_ns = recording.start_ns or 0, recording.end_ns or 0
        meters = _field_meters(connections, (start_ns + end_ns) // 2)
        decoders = {
            one.id: decoder_for(one)
            for one in connections
            if one.topic in meters or _has_header(one.definition)
        }
        for block in blocks:
            observer, decoder = observers[block.connection], decoders.get(block.connection)
            if observer is not None:
                observer.block(block.log_times)
            if observer is not None and decoder is not None:
                decoded = decoder.decode(block)
                observer.messages(decoded.rows, decoded.index)
                if observer.topic.name in meters:
                    meters[observer.topic.name].add(decoded.rows, block.log_times[decoded.index])
        result = monitor.finish()
        types = {connection.topic: connection.msgtype for connection in connections}
        return MeasuredRecording(
            {
                name: _measured_topic(
                    topic, types[name], result, meters[name].finish() if name in meters else {}
                )
                for name, topic in monitor.observed.items()
                if topic.read
            },
            end_ns - start_ns,
            frozenset(one.key for one in result.results if one.topic is None and _holds(one.outcome)),
        )


def draft_contract(recordings: Sequence[MeasuredRecording], *, tolerance: float = DEFAULT_TOLERANCE) -> str:
    """Return the text of a file with the section `expect`, which all of these recordings fulfill.

    The range of the recordings' values is widened by `tolerance` percent on both sides, and rounded outward.
    """
    share = tolerance / 100
    names = dict.fromkeys(name for one in recordings for name in one.topics)
    required = [name for name in names if all(name in one.topics for one in recordings)]
    lines = [
        f"# Drafted by `ingest init --expect` from {counted(len(recordings), 'recording')}: each limit is the range of their values,",
        f"# widened by {number_text(tolerance)}%. Review the limits, then write `extends: expect.yaml` in the manifests of the fleet.",
        "expect:",
        _line("  # on_failure: divert", "after a failure: fail (the default), warn, or divert"),
        *_recording_lines(recordings, share),
    ]
    if required:
        lines += ["  required:", *(f"    - {_quoted(name)}" for name in sorted(required))]
    if names:
        lines.append("  topics:")
    for name in sorted(names):
        lines += _topic_lines(name, [one.topics[name] for one in recordings if name in one.topics], share)
    return "\n".join(lines) + "\n"


def _field_meters(connections: Sequence[Connection], middle_ns: int) -> dict[str, FieldMeter]:
    """Return the meters of the topics with one message definition, by topic."""
    meters: dict[str, FieldMeter] = {}
    for topic in dict.fromkeys(connection.topic for connection in connections):
        definitions = [connection.definition for connection in connections if connection.topic == topic]
        first = definitions[0]
        if first is not None and all(one is not None and one.text == first.text for one in definitions):
            meter = FieldMeter(topic, first, middle_ns)
            if meter:
                meters[topic] = meter
    return meters


def _has_header(definition: object) -> bool:
    fields = getattr(getattr(definition, "message", None), "fields", ())
    return any(field.name == "header" for field in fields)


def _holds(outcome: Outcome) -> bool:
    return outcome is Outcome.PASSED


def _measured_topic(
    topic: TopicMonitor, msgtype: str, result: ContractResult, fields: Mapping[str, MeasuredField]
) -> MeasuredTopic:
    times = topic.times
    rows = [monitor for monitor in topic.rows.values() if monitor.has_header]
    latencies = [monitor.latency for monitor in rows if monitor.latency is not None and monitor.latency.count]
    lows = [int(one.lowest.value or 0) for one in latencies if one.lowest is not None]
    highs = [int(one.highest.value or 0) for one in latencies if one.highest is not None]
    is_stamped = bool(lows) and bool(highs) and not any(one.unset for one in latencies)
    steps = [(name, one) for monitor in rows for name, one in monitor.steps.items() if one.count]
    broken = {name for name, one in steps if one.violations.count}
    return MeasuredTopic(
        msgtype=msgtype,
        count=topic.read,
        rate_hz=mean_rate_hz(times.count, 0, times.span_ns),
        gap_ns=None if times.late or times.longest is None else times.longest.length_ns,
        latency_ns=(min(lows), max(highs)) if is_stamped else None,
        frames=frozenset(text for monitor in rows if monitor.frames for text in monitor.frames.seen),
        stamps=frozenset(name for name, _ in steps) - broken if is_stamped else frozenset(),
        fulfilled=frozenset(
            one.key for one in result.results if one.topic == topic.name and _holds(one.outcome)
        ),
        fields=fields,
    )


def _recording_lines(recordings: Sequence[MeasuredRecording], share: float) -> Iterator[str]:
    fulfilled = frozenset[str].intersection(*(one.fulfilled for one in recordings))
    lengths = [one.duration_ns for one in recordings]
    yield "  recording:"
    if min(lengths) > 0:
        low, high = _range(lengths, share)
        limits = f"{{min: {_written(low, up=False)}, max: {_written(high, up=True)}}}"
        yield _line(f"    duration: {limits}", _span_text(lengths, duration_text))
    if "unreadable" in fulfilled:
        yield "    unreadable: 0"
    if "chunk_crcs" in fulfilled:
        yield "    chunk_crcs: {present: true, valid: true}"
    if "metadata_counts" in fulfilled:
        yield "    metadata_counts: {equal: true}"
    if min(lengths) <= 0 and not fulfilled & {"unreadable", "chunk_crcs", "metadata_counts"}:
        yield "    messages: {min: 1}"


def _topic_lines(name: str, topics: Sequence[MeasuredTopic], share: float) -> Iterator[str]:
    counts = [topic.count for topic in topics]
    yield _line(f"    {_quoted(name)}:", f"{_span_text(counts, number_text)} messages")
    types = sorted({topic.msgtype for topic in topics})
    yield f"      type: {types[0] if len(types) == 1 else _flow(types)}"
    rates = [topic.rate_hz for topic in topics if topic.rate_hz is not None]
    gaps = [topic.gap_ns for topic in topics if topic.gap_ns is not None]
    if all(topic.is_regular for topic in topics):
        low, high = _range(rates, share)
        limits = f"{{min: {_rounded(low, up=False)} Hz, max: {_rounded(high, up=True)} Hz}}"
        yield _line(f"      rate: {limits}", f"{_span_text(rates, number_text)} Hz")
        longest = _written(_range(gaps, share)[1], up=True)
        yield _line(f"      gap: {{max: {longest}}}", _span_text(gaps, duration_text))
    else:
        yield f"      messages: {{min: {max(1, int(min(counts) * (1 - share)))}}}"
    yield from _header_lines(topics, share)
    fulfilled = frozenset[str].intersection(*(topic.fulfilled for topic in topics))
    if "out_of_order" in fulfilled:
        yield "      out_of_order: 0"
    if "sequence_numbers" in fulfilled:
        yield "      sequence_numbers: {missing: 0}"
    lines = list(_field_lines(topics, share)) if min(counts) >= _FEW_MESSAGES else []
    if lines:
        yield "      fields:"
        yield from lines


def _header_lines(topics: Sequence[MeasuredTopic], share: float) -> Iterator[str]:
    latencies = [topic.latency_ns for topic in topics if topic.latency_ns is not None]
    if len(latencies) == len(topics):
        lows, highs = [low for low, _ in latencies], [high for _, high in latencies]
        low, high = _range([*lows, *highs], share)
        limits = f"{{min: {_written(low, up=False)}, max: {_written(high, up=True)}}}"
        yield _line(f"      latency: {limits}", _span_text([*lows, *highs], duration_text))
    stamps = frozenset[str].intersection(*(topic.stamps for topic in topics))
    if stamps:
        names = sorted(stamps)
        yield f"      stamps: {names[0] if len(names) == 1 else _flow(names)}"
    frames = {frame for topic in topics for frame in topic.frames}
    if frames and all(frames) and len(frames) <= _MAX_FRAMES and all(topic.frames for topic in topics):
        yield f"      frame_id: {_flow(sorted(frames))}"


def _field_lines(topics: Sequence[MeasuredTopic], share: float) -> Iterator[str]:
    """Yield a line for each expression that all recordings have, and whose values an expectation can describe."""
    for text in topics[0].fields:
        measured = [topic.fields[text] for topic in topics if text in topic.fields]
        if len(measured) < len(topics):
            continue
        expected = [*_constants(measured), *_limits(measured, share)]
        if all(one.nulls == 0 for one in measured):
            expected.append("nulls: 0")
        if expected:
            limits = [limit for one in measured if one.limits is not None for limit in one.limits]
            line = f"        {plain(text)}: {{{', '.join(expected)}}}"
            yield _line(line, _span_text(limits, number_text)) if limits else line


def _constants(measured: Sequence[MeasuredField]) -> Iterator[str]:
    values = {one.constant for one in measured}
    if len(values) == 1 and None not in values:
        yield f"equals: {plain(values.pop())}"


def _limits(measured: Sequence[MeasuredField], share: float) -> Iterator[str]:
    """Yield the expectation of a number: its range if it is stable, or else that it is finite."""
    limits = [limit for one in measured if one.limits is not None for limit in one.limits]
    if len(limits) < 2 * len(measured) or not any(limits):
        return  # a number is not finite, or the field is not used
    kind = measured[0].kind
    if kind is FieldKind.QUATERNION:
        if _UNIT_NORM[0] <= min(limits) and max(limits) <= _UNIT_NORM[1]:
            yield f"between: [{_UNIT_NORM[0]}, {_UNIT_NORM[1]}]"
    elif not all(one.is_stable for one in measured) or max(map(abs, limits)) >= _MAX_LIMIT:
        yield "finite: true"
    else:
        low, high = _range(limits, share)
        upper = _rounded(high, up=True)
        is_maximum = kind is FieldKind.VECTOR and low < high / 2
        yield f"max: {upper}" if is_maximum else f"between: [{_rounded(low, up=False)}, {upper}]"


def _range(values: Sequence[float], share: float) -> tuple[float, float]:
    """Return the smallest and the largest value, moved apart by a share of their size."""
    low, high = min(values), max(values)
    return low - abs(low) * share, high + abs(high) * share


def _rounded(value: float | Decimal, *, up: bool) -> str:
    """Return a number with few significant digits that is not smaller (`up`) or not larger than the value."""
    exact = Decimal(value)
    step = Decimal(1).scaleb(exact.adjusted() - _DIGITS + 1) if exact else Decimal(1)
    rounded = exact.quantize(step, ROUND_CEILING if up else ROUND_FLOOR)
    return f"{rounded.normalize():f}"


def _written(ns: float, *, up: bool) -> str:
    """Return a duration in the notation of manifests, rounded as in `_rounded`, in whole nanoseconds."""
    units = _UNITS if abs(ns) >= _LONG_NS else _UNITS[1:]
    unit, name = next(((unit, name) for unit, name in units if abs(ns) >= unit), (1, "ns"))
    return f"{_rounded(Decimal(ns) / unit, up=up)} {name}"


def _span_text(values: Sequence[float], text: Callable[[float], str]) -> str:
    """Return the range of the values that the recordings have."""
    low, high = text(min(values)), text(max(values))
    return low if low == high else f"{low} .. {high}"


def _line(text: str, comment: str) -> str:
    return f"{text:{_COMMENT_COLUMN}}  # {comment}"


def _flow(texts: Iterable[str]) -> str:
    return f"[{', '.join(map(plain, texts))}]"


def _quoted(topic: str) -> str:
    return plain(escape(topic))


class FieldKind(Enum):
    """The kind of a measured expression."""

    FIELD = "field"
    VECTOR = "vector"
    """The norm of a vector."""
    QUATERNION = "quaternion"
    """The norm of a quaternion."""


class MeasuredField(Struct, frozen=True):
    """The values of an expression in one recording."""

    kind: FieldKind = FieldKind.FIELD
    limits: tuple[float, float] | None = None
    """The smallest and the largest floating-point number; None for other values, and if a number is not finite."""
    is_stable: bool = False
    """Whether both halves of the recording have about the same limits, and other recordings may have them, too."""
    constant: str | int | None = None
    """The only text or whole number of all messages; None if there are several, and for zero and empty texts."""
    nulls: int | None = None
    """Number of messages without a value; None if the type of the message requires a value."""


class FieldMeter:
    """Measures expressions over the messages of one topic."""

    def __init__(self, topic: str, definition: Definition, middle_ns: int) -> None:
        """Create the meter; `middle_ns` is the log time that divides the recording into halves."""
        self._topic = topic
        self._msgtype = definition.root
        self._middle_ns = middle_ns
        self._is_nullable = definition.language is not Language.ROS
        rows = message_rows(definition)
        meters: list[_Meter] = []
        for text, kind in _expressions(rows.struct, ""):
            expression, _ = bind_expression(text, rows, None, lambda _start, _end: None)
            if expression is not None and len(meters) < MAX_FIELDS:
                name = text.rstrip(")").rpartition(".")[2].removeprefix("norm(")
                meters.append(_Meter(expression, kind, is_geographic=name in _GEOGRAPHIC))
        self._meters = tuple(meters)

    def __bool__(self) -> bool:
        return bool(self._meters)

    def add(self, rows: pa.StructArray, log_times: NDArray[np.int64]) -> None:
        """Add decoded messages in the ROS shape."""
        evaluator = Evaluator(rows, Envelope(self._topic, self._msgtype, log_times))
        is_second = log_times >= self._middle_ns
        for meter in self._meters:
            meter.add(evaluator.values(meter.expression), is_second)

    def finish(self) -> dict[str, MeasuredField]:
        """Return the measured values by expression, without expressions that have no value."""
        return {
            meter.expression.text: meter.result(is_nullable=self._is_nullable)
            for meter in self._meters
            if meter.count
        }


@dataclass(slots=True)
class _Meter:
    """Measures one expression."""

    expression: FieldExpression
    kind: FieldKind
    is_geographic: bool
    count: int = 0
    nulls: int = 0
    is_finite: bool = True
    halves: list[tuple[float, float] | None] = field(default_factory=lambda: [None, None])
    """The smallest and the largest number of each half of the recording."""
    constants: set[str | int] = field(default_factory=set[str | int])
    """The different texts or whole numbers, no more after the second one."""

    def add(self, values: Values, is_second: NDArray[np.bool_]) -> None:
        """Add the values of a batch, one per row."""
        data = values.data
        if values.null is not None:
            self.nulls += int(values.null.sum())
            data, is_second = data[~values.null], is_second[~values.null]
        if not len(data):
            return
        self.count += len(data)
        if not np.issubdtype(data.dtype, np.floating):
            if len(self.constants) <= 1:
                self.constants |= {data[0], *data[data != data[0]][:1]}
        elif not np.isfinite(data).all():
            self.is_finite = False
        else:
            for half, of_half in enumerate((data[~is_second], data[is_second])):
                if len(of_half):
                    low, high = self.halves[half] or (np.inf, -np.inf)
                    self.halves[half] = (min(low, float(of_half.min())), max(high, float(of_half.max())))

    def result(self, *, is_nullable: bool) -> MeasuredField:
        """Return the measured values."""
        halves = [half for half in self.halves if half is not None] if self.is_finite else []
        limits = (min(low for low, _ in halves), max(high for _, high in halves)) if halves else None
        distance = 0.0 if limits is None else _STABLE_SHARE * (limits[1] - limits[0])
        (constant,) = self.constants if len(self.constants) == 1 else (None,)
        return MeasuredField(
            kind=self.kind,
            limits=limits,
            is_stable=len(halves) == len(self.halves)
            and not self.is_geographic
            and all(abs(first - second) <= distance for first, second in zip(*halves, strict=True)),
            constant=_plain(constant) if constant else None,
            nulls=self.nulls if is_nullable else None,
        )


def _expressions(struct: pa.StructType, prefix: str) -> Iterator[tuple[str, FieldKind]]:
    """Yield the norms of the vectors and quaternions of a message, and its other numbers and texts outside of lists."""
    for member in struct:
        path, kind = f"{prefix}{member.name}", member.type
        if pt.is_struct(kind):
            names = {child.name for child in kind}
            is_floating = all(pt.is_floating(child.type) for child in kind)
            if is_floating and names == _QUATERNION:
                yield f"norm({path})", FieldKind.QUATERNION
            elif is_floating and names in _VECTORS:
                yield f"norm({path})", FieldKind.VECTOR
            elif names not in _TIMES and member.name != "header":
                yield from _expressions(kind, f"{path}.")
        elif is_number(kind) or pt.is_string(kind):
            yield path, FieldKind.FIELD


def _plain(constant: str | int) -> str | int | None:
    """Return a constant as a Python value; None for a text that is too long."""
    if isinstance(constant, str):
        return constant if len(constant) <= _MAX_TEXT else None
    return int(constant)
