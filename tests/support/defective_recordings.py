"""Recordings with one defect each, and their clean twins.

The clean drive lasts 10 s: `/temperature` at 50 Hz and `/ambient` at 10 Hz, both with header stamps 5 ms before their log
times. Each defect changes one thing about it and has the contract that finds this change.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from made_recordings import define
from mcap.writer import CompressionType, Writer

from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.serialization import Serializer

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
START_NS = 1_767_225_600 * SECOND
LATENCY_NS = 5 * MILLISECOND
_HEADER = f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
TEMPERATURE = define(
    "sensor_msgs/msg/Temperature", f"std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n{_HEADER}"
)
PRESSURE = define(
    "sensor_msgs/msg/FluidPressure",
    f"std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n{_HEADER}",
)
SINGLE_PRECISION = define(
    "sensor_msgs/msg/Temperature", f"std_msgs/Header header\nfloat32 temperature\nfloat64 variance\n{_HEADER}"
)


@dataclass(frozen=True)
class Message:
    """One message of a drive."""

    topic: str
    log_ns: int
    value: float
    sequence: int
    latency_ns: int = LATENCY_NS
    frame_id: str = "sensor"
    truncated: bool = False


@dataclass(frozen=True)
class Drive:
    """A recording before it is written."""

    messages: tuple[Message, ...]
    definitions: Mapping[str, Definition] = field(default_factory=dict[str, Definition])
    """The definitions of topics other than temperatures."""
    name: str = "drive.mcap"
    crcs: bool = True
    damaged: bool = False
    """Whether a byte of the first chunk's data is flipped, which its checksum reveals."""
    counts: Mapping[str, int] | None = None
    """The counts of a `metadata.yaml`; the recording is then a directory."""
    vehicle: str = "r1"
    """The vehicle in the side-car file."""


@dataclass(frozen=True)
class Defect:
    """A defect with the contract that finds it."""

    name: str
    change: Callable[[Drive], Drive]
    contract: str
    """The content of the section `expect`, or other sections of the manifest."""
    keys: tuple[str, ...]
    """The keys of the expectations that fail, or the ids of the rules that are violated."""
    clean: Callable[[Drive], Drive] = lambda drive: drive
    """The change that makes the clean twin; the defect is applied to the twin."""


def clean_drive() -> Drive:
    """Return the drive without a defect."""
    messages = [
        Message(topic, START_NS + number * SECOND // rate, 20 + math.sin(number), number)
        for topic, rate in (("/temperature", 50), ("/ambient", 10))
        for number in range(10 * rate + 1)
    ]
    return Drive(tuple(sorted(messages, key=lambda message: message.log_ns)))


def write_drive(drive: Drive, folder: Path) -> Path:
    """Write a drive with its side-car file; return the path of the recording."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / drive.name).with_suffix(".json").write_text(f'{{"vehicle": "{drive.vehicle}"}}')
    content = _mcap(drive)
    if drive.counts is None:
        (folder / drive.name).write_bytes(content)
        return folder / drive.name
    directory = folder / Path(drive.name).stem
    directory.mkdir()
    (directory / drive.name).write_bytes(content)
    topics = "".join(
        f"    - topic_metadata: {{name: {topic}, type: sensor_msgs/msg/Temperature, serialization_format: cdr}}\n"
        f"      message_count: {count}\n"
        for topic, count in drive.counts.items()
    )
    (directory / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n"
        f"  relative_file_paths: [{drive.name}]\n  message_count: {sum(drive.counts.values())}\n"
        f"  topics_with_message_count:\n{topics}"
    )
    return directory


def _mcap(drive: Drive) -> bytes:
    """Return the MCAP file of a drive; its chunks hold about a second each."""
    buffer = io.BytesIO()
    writer = Writer(
        buffer, chunk_size=4096, compression=CompressionType.NONE, enable_crcs=drive.crcs, use_chunking=True
    )
    writer.start("ros2")
    channels: dict[str, int] = {}
    serializers: dict[str, Serializer] = {}
    for message in drive.messages:
        definition = drive.definitions.get(message.topic, TEMPERATURE)
        if message.topic not in channels:
            schema = writer.register_schema(definition.root, "ros2msg", definition.text.encode())
            channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
            serializers[message.topic] = Serializer(definition, Encoding.CDR)
        payload = serializers[message.topic].from_dict(_values(message, definition))
        if message.truncated:
            payload = payload[:10]
        writer.add_message(
            channels[message.topic], message.log_ns, bytes(payload), message.log_ns, sequence=message.sequence
        )
    writer.finish()
    content = bytearray(buffer.getvalue())
    if drive.damaged:
        content[content.index(b"sensor", content.index(b"MSG: std_msgs/Header") + 500)] ^= 1
    return bytes(content)


def _values(message: Message, definition: Definition) -> dict[str, object]:
    stamp_ns = message.log_ns - message.latency_ns
    stamp = {"sec": stamp_ns // SECOND, "nanosec": stamp_ns % SECOND}
    first = definition.message.fields[1].name
    return {
        "header": {"stamp": stamp, "frame_id": message.frame_id},
        first: message.value,
        "variance": 0.0,
    }


def _where(
    condition: Callable[[Message], bool], change: Callable[[Message], Message | None]
) -> Callable[[Drive], Drive]:
    """Return a change of the messages of `/temperature` for which a condition is true; None drops a message."""

    def apply(drive: Drive) -> Drive:
        changed = [
            change(one) if one.topic == "/temperature" and condition(one) else one for one in drive.messages
        ]
        return replace(drive, messages=tuple(one for one in changed if one is not None))

    return apply


def _between(start_s: float, end_s: float) -> Callable[[Message], bool]:
    """Return whether a message is between two offsets from the start, in seconds."""
    return lambda message: start_s * SECOND < message.log_ns - START_NS < end_s * SECOND


def _renumbered(drive: Drive) -> Drive:
    """Return a drive whose messages are numbered without gaps, so that only the intended defect remains."""
    numbers: dict[str, int] = {}
    messages: list[Message] = []
    for message in drive.messages:
        number = numbers.get(message.topic, 0)
        numbers[message.topic] = number + 1
        messages.append(replace(message, sequence=number))
    return replace(drive, messages=tuple(messages))


def _drop(start_s: float, end_s: float) -> Callable[[Drive], Drive]:
    return lambda drive: _renumbered(_where(_between(start_s, end_s), lambda _: None)(drive))


def _topic(contract: str) -> str:
    return f"expect: {{topics: {{/temperature: {{{contract}}}}}}}\n"


def _out_of_order(drive: Drive) -> Drive:
    messages = list(drive.messages)
    messages[100:110] = reversed(messages[100:110])
    return replace(drive, messages=tuple(messages))


def _doubled(drive: Drive) -> Drive:
    """Return a drive with a second message 1 ms after each message of the second half of `/temperature`."""
    extra = [
        replace(message, log_ns=message.log_ns + MILLISECOND)
        for message in drive.messages
        if message.topic == "/temperature" and message.log_ns > START_NS + 5 * SECOND
    ]
    merged = sorted((*drive.messages, *extra), key=lambda message: message.log_ns)
    return _renumbered(replace(drive, messages=tuple(merged)))


def _without(topic: str) -> Callable[[Drive], Drive]:
    return lambda drive: replace(
        drive, messages=tuple(message for message in drive.messages if message.topic != topic)
    )


def _debug_topic(drive: Drive) -> Drive:
    return replace(drive, messages=(*drive.messages, replace(drive.messages[-1], topic="/debug/raw")))


def _with_definition(definition: Definition) -> Callable[[Drive], Drive]:
    return lambda drive: replace(drive, definitions={"/temperature": definition})


def _with_counts(surplus: int) -> Callable[[Drive], Drive]:
    def apply(drive: Drive) -> Drive:
        topics = [message.topic for message in drive.messages]
        counts = {topic: topics.count(topic) for topic in dict.fromkeys(topics)}
        return replace(drive, counts={**counts, "/ambient": counts["/ambient"] + surplus})

    return apply


def _drifting(message: Message) -> Message:
    """Return a message whose header clock lags behind by 2 % of the elapsed time."""
    return replace(message, latency_ns=LATENCY_NS + (message.log_ns - START_NS) // 50)


_ALL = lambda _: True  # noqa: E731 - a condition

DEFECTS = (
    Defect("gap", _drop(4, 6), _topic("gap: {max: 50 ms}"), ("gap",)),
    Defect("drifting clock", _where(_ALL, _drifting), _topic("latency: {max: 20 ms}"), ("latency",)),
    Defect(
        "stuck sensor",
        _where(_between(3, 6), lambda one: replace(one, value=20.0)),
        _topic("fields: {temperature: {unchanged: {max: 1s}}}"),
        ("unchanged",),
    ),
    Defect(
        "NaN burst",
        _where(_between(3, 3.5), lambda one: replace(one, value=math.nan)),
        _topic("fields: {temperature: {finite: true}}"),
        ("finite",),
    ),
    Defect(
        "value out of range",
        _where(_between(3, 3.1), lambda one: replace(one, value=85.0)),
        _topic("fields: {temperature: {between: [15, 25]}}"),
        ("between",),
    ),
    Defect(
        "jumping value",
        _where(_between(3, 3.03), lambda one: replace(one, value=28.0)),
        _topic("fields: {temperature: {change: {max: 3}}}"),
        ("change",),
    ),
    Defect(
        "frame change",
        _where(_between(5, 99), lambda one: replace(one, frame_id="sensr")),
        _topic("frame_id: [sensor]"),
        ("frame_id",),
    ),
    Defect("missing topic", _without("/ambient"), "expect: {required: [/ambient]}\n", ("required",)),
    Defect("forbidden topic", _debug_topic, 'expect: {forbidden: ["/debug/*"]}\n', ("forbidden",)),
    Defect(
        "duplicate stamps",
        _where(_between(3, 3.03), lambda one: replace(one, latency_ns=LATENCY_NS + 20 * MILLISECOND)),
        _topic("stamps: unique"),
        ("stamps",),
    ),
    Defect(
        "stamps in the past",
        _where(_between(3, 3.03), lambda one: replace(one, latency_ns=LATENCY_NS + 90 * MILLISECOND)),
        _topic("stamps: monotonic"),
        ("stamps",),
    ),
    Defect("out-of-order log times", _out_of_order, _topic("out_of_order: 0"), ("out_of_order",)),
    Defect(
        "dropped sequence numbers",
        _where(_between(3, 3.05), lambda _: None),
        _topic("sequence_numbers: {missing: 0}"),
        ("sequence_numbers",),
    ),
    Defect("wrong type", _with_definition(PRESSURE), _topic("type: sensor_msgs/msg/Temperature"), ("type",)),
    Defect("late start", _drop(-1, 2), _topic("start: {within: 1s}"), ("start",)),
    Defect("early end", _drop(8, 99), _topic("end: {within: 1s}"), ("end",)),
    Defect("rate too high", _doubled, _topic("rate: {min: 45 Hz, max: 55 Hz}"), ("rate",)),
    Defect(
        "slow stretch",
        lambda drive: _renumbered(
            _where(lambda one: _between(4, 6)(one) and one.sequence % 2 == 1, lambda _: None)(drive)
        ),
        _topic("sliding_rate: {window: 1s, min: 40 Hz}"),
        ("sliding_rate",),
    ),
    Defect(
        "frequent gaps",
        lambda drive: _renumbered(_where(lambda one: one.sequence % 5 in {1, 2}, lambda _: None)(drive)),
        _topic("gaps: {over: 2 periods, max_share: 5%}"),
        ("gaps",),
    ),
    Defect("partial coverage", _drop(2, 5), _topic("coverage: {min: 99%, gap: 100 ms}"), ("coverage",)),
    Defect(
        "latency burst",
        _where(_between(3, 3.2), lambda one: replace(one, latency_ns=400 * MILLISECOND)),
        _topic("latency: {max: 20 ms}"),
        ("latency",),
    ),
    Defect(
        "rejected messages",
        _where(_between(3, 3.05), lambda one: replace(one, truncated=True)),
        f"{_topic('rejected: 0')}on_error: {{topic: ignore}}\n",
        ("rejected",),
    ),
    Defect(
        "short recording",
        lambda drive: replace(
            drive, messages=tuple(one for one in drive.messages if one.log_ns < START_NS + 3 * SECOND)
        ),
        "expect: {recording: {duration: {min: 5s}}}\n",
        ("duration",),
    ),
    Defect(
        "missing chunk CRC",
        lambda drive: replace(drive, crcs=False),
        "expect: {recording: {chunk_crcs: {present: true, valid: true}}}\n",
        ("chunk_crcs",),
    ),
    Defect(
        "wrong chunk CRC",
        lambda drive: replace(drive, damaged=True),
        "expect: {recording: {chunk_crcs: {present: true, valid: true}}}\n",
        ("chunk_crcs",),
    ),
    Defect(
        "count differs from metadata.yaml",
        _with_counts(3),
        "expect: {recording: {metadata_counts: {equal: true}}}\n",
        ("metadata_counts",),
        clean=_with_counts(0),
    ),
    Defect(
        "wrong metadata",
        lambda drive: replace(drive, vehicle="x1"),
        'sequence: {metadata_from: {sidecar: "{stem}.json"}, metadata_schema: vehicle.schema.json}\n',
        ("metadata-schema",),
    ),
    Defect(
        "changed definition",
        _with_definition(SINGLE_PRECISION),
        "definitions: locked\n",
        ("definition-difference",),
    ),
)
