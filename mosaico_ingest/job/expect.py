"""The section `expect`: the data contract of a recording.

Each expectation is a mapping, so that it can have a severity of its own; frequent ones have a short form, such as
`stamps: monotonic` for `stamps: {order: monotonic}`.
"""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import AfterValidator, Discriminator, Field, Tag, WithJsonSchema

from mosaico_ingest.job.fields import MessageLimit, Parsed, Section, Text, Topic, TopicGlob, shape_of
from mosaico_ingest.job.values import (
    RECORDING,
    Interval,
    OnFailure,
    TimeBound,
    first_match,
    format_duration,
    format_time,
    parse_duration,
    parse_instant,
    parse_interval,
    parse_rate,
    parse_share,
)

_MAX_COUNT = 10**15

SeverityName: TypeAlias = Literal["error", "warning"]


def _check_scalar(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    if not isinstance(value, str | int | float | bool):
        raise ValueError("a value must be text, a number, or true or false")  # noqa: TRY004 - validators raise ValueError
    return value


def _check_finite(value: float) -> float:
    if not isfinite(value):
        raise ValueError("the number must be finite")
    return value


def _check_pair(value: tuple[float, ...]) -> tuple[float, ...]:
    if len(value) != 2:  # noqa: PLR2004 - a smallest and a largest number
        raise ValueError("write two numbers, such as [-40, 40]")
    return value


def _form(value: Any) -> str:  # noqa: ANN401 - any YAML value
    """Return the tag of a value in a union with a text, a list and a mapping."""
    if isinstance(value, list | tuple):
        return "list"
    return "mapping" if isinstance(value, dict | Section) else "one"


def _short_form(value: Any) -> str:  # noqa: ANN401 - any YAML value
    return "several" if isinstance(value, Section) else shape_of(value)


_DURATION = r"^[0-9.]+ ?(ns|us|ms|s|min|h|d)$"
Duration = Annotated[int, Parsed(parse_duration, _DURATION, to_json=format_duration)]
SignedDuration = Annotated[
    int,
    Parsed(lambda text: parse_duration(text, signed=True), "^[+-]?" + _DURATION[1:], to_json=format_duration),
]
Instant = Annotated[
    int,
    Parsed(parse_instant, r"^[0-9]{4}-[0-9]{2}-[0-9]{2}.*$", to_json=lambda ns: format_time(TimeBound(ns))),
]
Frequency = Annotated[
    float, Parsed(parse_rate, r"^[0-9.]+ ?(mHz|Hz|kHz|/s|/min|/h)$", to_json=lambda hz: f"{hz:g} Hz")
]
Share = Annotated[float, Parsed(parse_share, r"^[0-9.]+ ?%$", to_json=lambda share: f"{100 * share:g}%")]
IntervalLimit = Annotated[
    Interval, Parsed(parse_interval, r"^[0-9.]+ ?(ns|us|ms|s|min|h|d|periods?)$", to_json=str)
]
Number = Annotated[float, AfterValidator(_check_finite)]
Pair = Annotated[tuple[Number, ...], AfterValidator(_check_pair)]
Scalar = Annotated[
    Any,
    AfterValidator(_check_scalar),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "number"}, {"type": "boolean"}]}),
]
Amount = Annotated[int, Field(ge=0, le=_MAX_COUNT)]
SpanOwner = Annotated[Text, TopicGlob(default=RECORDING)]
"""The `recording`, or the name of the topic whose time span an expectation refers to."""


class Expectation(Section):
    """An expectation with a severity."""

    severity: SeverityName | None = None
    """Whether a failure is an error or a warning. Defaults to the `severity` of the entry, then to `expect.severity`."""


class DurationRange(Expectation):
    """A range of durations."""

    min: Duration | None = Field(default=None, examples=["30s"])
    """The shortest duration."""
    max: Duration | None = Field(default=None, examples=["2h"])
    """The longest duration."""


class InstantRange(Expectation):
    """A range of instants in ISO 8601, in UTC unless they have an offset."""

    after: Instant | None = Field(default=None, examples=["2026-01-01"])
    """The earliest instant, inclusive."""
    before: Instant | None = Field(default=None, examples=["2027-01-01T00:00:00Z"])
    """The latest instant, exclusive."""


class CountRange(Expectation):
    """A range of message counts."""

    min: Amount | None = Field(default=None, examples=[1000])
    """The smallest number of messages."""
    max: Amount | None = Field(default=None, examples=[100000])
    """The largest number of messages."""


class NumberRange(Expectation):
    """A range of numbers."""

    min: Number | None = Field(default=None, examples=[9.7])
    """The smallest number."""
    max: Number | None = Field(default=None, examples=[9.9])
    """The largest number."""


class Limit(Expectation):
    """A maximum number or share of messages."""

    max: MessageLimit = Field(examples=[0, "0.1%"])
    """The largest number (`10`) or share (`0.1%`)."""


class Rate(Expectation):
    """A range of mean rates over the time between the first and the last message."""

    min: Frequency | None = Field(default=None, examples=["95 Hz"])
    """The lowest rate."""
    max: Frequency | None = Field(default=None, examples=["105 Hz"])
    """The highest rate."""


class SlidingRate(Rate):
    """A range of rates in every window of the topic's time span. A window starts or ends at each message."""

    window: Duration = Field(examples=["1s"])
    """The length of the windows."""


class GapLimit(Expectation):
    """The longest interval between consecutive messages."""

    max: Duration = Field(examples=["50 ms"])
    """The longest interval."""


class GapShare(Expectation):
    """The share of long intervals between consecutive messages."""

    over: IntervalLimit = Field(examples=["2 periods", "100 ms"])
    """The length from which an interval counts as long, exclusive: a duration, or a multiple of the topic's period, which
    is the median of its first 1,000 intervals."""
    max_share: Share = Field(examples=["5%"])
    """The largest share of all intervals."""


class Latency(Expectation):
    """A range of latencies: log time minus header stamp. A stamp of zero fails the expectation."""

    min: SignedDuration | None = Field(default=None, examples=["-5 ms"])
    """The smallest latency, negative if a stamp may be later than the log time."""
    max: SignedDuration | None = Field(default=None, examples=["200 ms"])
    """The largest latency."""


StampProperty: TypeAlias = Literal["monotonic", "unique"]
StampProperties = Annotated[
    Annotated[StampProperty, Tag("one")]
    | Annotated[tuple[StampProperty, ...], Field(min_length=1), Tag("several")],
    Discriminator(shape_of),
]


class StampOrder(Expectation):
    """Properties of the header stamps."""

    order: StampProperties = Field(examples=["monotonic", ["monotonic", "unique"]])
    """`monotonic`: no stamp is earlier than the previous one. `unique`: no two consecutive stamps are equal."""


class AllowedNames(Expectation):
    """Allowed texts."""

    one_of: Annotated[tuple[Text, ...], Field(min_length=1)] = Field(examples=[["imu_link"]])
    """The allowed texts."""


class SequenceNumbers(Expectation):
    """The continuity of the sequence numbers of MCAP messages, or else of `header.seq` of ROS 1."""

    missing: MessageLimit = Field(examples=[0, "0.1%"])
    """The largest number (or share of all numbers) of sequence numbers that no message has."""


class Coverage(Expectation):
    """The share of an interval that a topic covers. Time between messages that are at most `gap` apart is covered."""

    min: Share = Field(examples=["99%"])
    """The smallest share."""
    gap: IntervalLimit = Field(examples=["1s", "3 periods"])
    """The longest interval between consecutive messages that counts as covered, as in `gaps.over`."""
    of: SpanOwner = Field(default=RECORDING, examples=["recording", "/clock"])
    """The interval: the time span of the `recording`, or of a topic by its name."""


class Proximity(Expectation):
    """The largest distance between the first or last messages of the topic and of the recording or another topic."""

    within: Duration = Field(examples=["1s"])
    """The largest distance."""
    of: SpanOwner = Field(default=RECORDING, examples=["recording", "/clock"])
    """The `recording`, or a topic by its name."""


class StuckLimit(Expectation):
    """The longest time for which a value does not change."""

    max: Duration = Field(examples=["5s"])
    """The longest time."""


class FieldExpectations(Expectation):
    """Expectations of the values of an expression. If it has several values per message, each of them is checked."""

    between: Pair | None = Field(default=None, examples=[[-40, 40]])
    """The smallest and largest number. NaN is in no range; null is in every range, see `nulls`."""
    min: Number | None = Field(default=None, examples=[0])
    """The smallest number."""
    max: Number | None = Field(default=None, examples=[100])
    """The largest number."""
    finite: bool | None = None
    """Whether NaN and infinity are violations."""
    nulls: MessageLimit | None = Field(default=None, examples=[0, "1%"])
    """The largest number (or share of the values) of nulls."""
    equals: Scalar | None = Field(default=None, examples=["imu_link"])
    """The only allowed value."""
    one_of: Annotated[tuple[Scalar, ...], Field(min_length=1)] | None = Field(
        default=None, examples=[[0, 1, 2]]
    )
    """The allowed values."""
    mean: NumberRange | None = Field(default=None, examples=[{"min": 9.7, "max": 9.9}])
    """The mean of all finite values."""
    std: NumberRange | None = Field(default=None, examples=[{"min": 0.001}])
    """The standard deviation of all finite values (of the population)."""
    change: NumberRange | None = Field(default=None, examples=[{"max": 5}])
    """The absolute difference between the values of consecutive messages; only for one value per message."""
    unchanged: StuckLimit | None = Field(default=None, examples=[{"max": "5s"}])
    """The time for which consecutive messages have the same value, which shows a stuck sensor; only for one value per
    message."""


Maximum = Annotated[
    Annotated[MessageLimit, Tag("one")] | Annotated[Limit, Tag("several")], Discriminator(_short_form)
]
"""A maximum number or share, or `{max: …}`."""
Names = Annotated[
    Annotated[Text, Tag("one")]
    | Annotated[tuple[Text, ...], Field(min_length=1), Tag("list")]
    | Annotated[AllowedNames, Tag("mapping")],
    Discriminator(_form),
]
"""An allowed text, a list of them, or `{one_of: […]}`."""
Stamps = Annotated[
    Annotated[StampProperty, Tag("one")]
    | Annotated[tuple[StampProperty, ...], Field(min_length=1), Tag("list")]
    | Annotated[StampOrder, Tag("mapping")],
    Discriminator(_form),
]
"""A property of the stamps, a list of them, or `{order: …}`."""


class TopicExpectations(Section):
    """Expectations of the topics that a name or glob matches."""

    severity: SeverityName | None = None
    """The severity of the expectations of this entry. Defaults to `expect.severity`."""
    type: Names | None = Field(default=None, examples=["sensor_msgs/msg/Imu"])
    """The message type, or a list of allowed types; short for `{one_of: […]}`."""
    rate: Rate | None = Field(default=None, examples=[{"min": "95 Hz", "max": "105 Hz"}])
    """The mean rate over the time between the first and the last message."""
    sliding_rate: SlidingRate | None = Field(default=None, examples=[{"window": "1s", "min": "90 Hz"}])
    """The rate in every window of the topic's time span."""
    gap: GapLimit | None = Field(default=None, examples=[{"max": "50 ms"}])
    """The longest interval between consecutive messages."""
    gaps: GapShare | None = Field(default=None, examples=[{"over": "2 periods", "max_share": "5%"}])
    """The share of long intervals between consecutive messages."""
    messages: CountRange | None = Field(default=None, examples=[{"min": 1000}])
    """The number of messages."""
    rejected: Maximum | None = Field(default=None, examples=[0, "0.1%"])
    """The largest number or share of rejected messages; short for `{max: …}`."""
    latency: Latency | None = Field(default=None, examples=[{"max": "200 ms"}])
    """The log time minus the header stamp."""
    stamps: Stamps | None = Field(default=None, examples=["monotonic", ["monotonic", "unique"]])
    """The order of the header stamps: `monotonic`, `unique`, or both; short for `{order: …}`."""
    frame_id: Names | None = Field(default=None, examples=["imu_link", ["imu_link", "imu"]])
    """The allowed values of `header.frame_id`; short for `{one_of: […]}`."""
    sequence_numbers: SequenceNumbers | None = Field(default=None, examples=[{"missing": 0}])
    """The continuity of the messages' sequence numbers."""
    out_of_order: Maximum | None = Field(default=None, examples=[0])
    """The largest number or share of messages with an earlier log time than the message before them in the file; short for
    `{max: …}`."""
    coverage: Coverage | None = Field(default=None, examples=[{"min": "99%", "gap": "1s"}])
    """The share of the recording, or of another topic's time span, that the topic covers."""
    start: Proximity | None = Field(default=None, examples=[{"within": "1s"}])
    """The distance of the first message from the start of the recording or of another topic."""
    end: Proximity | None = Field(default=None, examples=[{"within": "1s", "of": "/clock"}])
    """The distance of the last message from the end of the recording or of another topic."""
    fields: dict[Text, FieldExpectations] = Field(
        default={}, examples=[{"linear_acceleration.z": {"between": [-40, 40], "finite": True}}]
    )
    """Expectations by expression of the mapping language, over the fields of the message or the columns of its ontology
    type."""


class ChunkCRCs(Expectation):
    """The checksums of the chunks of MCAP files."""

    present: bool = True
    """Whether every chunk must have a checksum."""
    valid: bool = True
    """Whether the checksums must match the chunks."""


class MetadataCounts(Expectation):
    """The message counts of a rosbag2 `metadata.yaml`."""

    equal: Literal[True] = True
    """The counts in `metadata.yaml` must equal those in the files."""


class RecordingExpectations(Section):
    """Expectations of the recording."""

    severity: SeverityName | None = None
    """The severity of the expectations of this section. Defaults to `expect.severity`."""
    duration: DurationRange | None = Field(default=None, examples=[{"min": "30s", "max": "2h"}])
    """The time between the first and the last message."""
    start: InstantRange | None = Field(default=None, examples=[{"after": "2026-01-01"}])
    """The log time of the first message."""
    end: InstantRange | None = Field(default=None, examples=[{"before": "2027-01-01"}])
    """The log time of the last message."""
    messages: CountRange | None = Field(default=None, examples=[{"min": 1000}])
    """The number of messages of all topics."""
    unreadable: Maximum | None = Field(default=None, examples=[0, "0.1%"])
    """The largest number or share of unreadable messages; short for `{max: …}`. An unreadable range with an unknown number
    of messages counts as one message."""
    chunk_crcs: ChunkCRCs | None = Field(default=None, examples=[{"present": True, "valid": True}])
    """The checksums of the chunks of MCAP files."""
    metadata_counts: MetadataCounts | None = Field(default=None, examples=[{"equal": True}])
    """The message counts of a rosbag2 `metadata.yaml`."""


class GroupExpectations(Section):
    """Expectations of several recordings of one run, which are checked before any of them is ingested."""

    by: Literal["job", "folder"] = "job"
    """The recordings that belong together: all of the job, or those in the same folder."""
    severity: SeverityName | None = None
    """The severity of the expectations of this section. Defaults to `expect.severity`."""
    files: tuple[Text, ...] = Field(default=(), examples=[["*_lidar.mcap", "*_imu.mcap"]])
    """Globs of file names; each must match at least one recording of the group."""
    starts: GroupDistance | None = Field(default=None, examples=[{"within": "5s"}])
    """The largest distance between the first messages of the recordings."""
    ends: GroupDistance | None = Field(default=None, examples=[{"within": "5s"}])
    """The largest distance between the last messages of the recordings."""
    gap: GapLimit | None = Field(default=None, examples=[{"max": "1s"}])
    """The longest time between two recordings that no recording of the group covers."""


class GroupDistance(Expectation):
    """The largest distance between moments of several recordings."""

    within: Duration = Field(examples=["5s"])
    """The largest distance."""


class ExpectedTopic(Expectation):
    """A topic pattern with a severity."""

    topic: Topic = Field(examples=["/gps/fix"])
    """The topic's name, or a glob."""


TopicItem = Annotated[
    Annotated[Topic, Tag("one")] | Annotated[ExpectedTopic, Tag("several")], Discriminator(_short_form)
]


class Expectations(Section):
    """A data contract: expectations of a recording, and the action if one of them fails."""

    on_failure: OnFailure = OnFailure.FAIL
    """Action if an expectation with the severity `error` fails: fail (commit nothing, exit code 6), warn (commit), divert
    (commit as `<name>__failed`, exit code 6)."""
    severity: SeverityName = "error"
    """The default severity of the expectations. A failure with the severity `warning` is only reported."""
    recording: RecordingExpectations | None = None
    """Expectations of the recording."""
    required: tuple[TopicItem, ...] = Field(default=(), examples=[["/imu", "/camera/*/image_raw"]])
    """Topic names and globs, or `{topic: …, severity: …}`; each must match a topic with at least one message."""
    forbidden: tuple[TopicItem, ...] = Field(default=(), examples=[["/debug/*"]])
    """Topic names and globs, or `{topic: …, severity: …}`; none may match a topic with messages."""
    topics: dict[Topic, TopicExpectations] = Field(
        default={}, examples=[{"/imu": {"rate": {"min": "95 Hz"}, "gap": {"max": "50 ms"}}}]
    )
    """Expectations per topic name or glob. For each expectation, and for each expression of `fields`, the exact topic name
    takes precedence, followed by the first matching glob that defines it."""
    group: GroupExpectations | None = None
    """Expectations of several recordings of one run."""

    def entry_of(self, topic: str, key: str) -> str | None:
        """Return the name or glob of the entry that defines an expectation of a topic; None if no entry does."""
        globs = (glob for glob, entry in self.topics.items() if key in entry.model_fields_set)
        return first_match(globs, topic)

    def fields_of(self, topic: str) -> dict[str, str]:
        """Return the expressions that apply to a topic, each with the name or glob of its entry."""
        expressions = dict.fromkeys(
            expression for entry in self.topics.values() for expression in entry.fields
        )
        globs = {
            expression: first_match(
                (glob for glob, entry in self.topics.items() if expression in entry.fields), topic
            )
            for expression in expressions
        }
        return {expression: glob for expression, glob in globs.items() if glob is not None}
