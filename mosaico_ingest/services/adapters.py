"""Tools for adapters: list, explain, test, try and draft them."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from fnmatch import fnmatchcase
from os.path import relpath
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapted, Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.bridge import ROSBridge, installed_adapters, load_adapter_reference, outputs_of
from mosaico_ingest.adapters.builtin import BUILTIN, Builtin
from mosaico_ingest.adapters.draft import Description, RecordedExample, describe, draft, unread_fields
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.mapping.model import RecordedMessage, Scalar
from mosaico_ingest.adapters.standalone import CaseResult, DefinitionFinder, mapping_of, run_tests
from mosaico_ingest.decode.decoder import decoder_for
from mosaico_ingest.errors import AdapterError, BagError, DecodeError, NothingMatched
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.job.model import Job
from mosaico_ingest.pipeline.compile import compile_manifest
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task, open_job
from mosaico_ingest.rosbag.blocks import Connection, MessageBlock
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import (
    Definition,
    Resolver,
    Source,
    normalize_msgtype,
    short_msgtype,
)
from mosaico_ingest.rosbag.definitions.registry import CustomMessages
from mosaico_ingest.rosbag.recording import Recording, open_recording

_BATCH_ROWS = 64


_FILES = (".py", ".yaml", ".yml")
_TRIAL_ROWS = 64


def message_in(
    path: Path, topic: str, index: int = 0, *, resolve: Resolver
) -> tuple[Definition, pa.StructArray, Envelope]:
    """Return the definition of a topic's message, the message as a single row in its ROS shape, and its envelope.

    Raises:
        BagError: The recording cannot be opened, has fewer messages, or the message cannot be decoded.
        NothingMatched: There is no such topic.
    """
    with open_recording(path, resolve=resolve) as recording:
        return _message_in(recording, topic, index)


def _message_in(
    recording: Recording, topic: str, index: int = 0
) -> tuple[Definition, pa.StructArray, Envelope]:
    before = 0
    ids = [connection.id for connection in topic_connections(recording, topic)]
    for batch in recording.message_blocks(ids, max_rows=_BATCH_ROWS):
        if index < before + len(batch):
            connection = recording.connections[batch.connection]
            one = batch.rows(np.array([index - before]))
            envelope = Envelope(topic, connection.msgtype, one.log_times, one.publish_times, one.sequences)
            return _definition(connection), _row(connection, one), envelope
        before += len(batch)
    raise BagError(
        f"{topic} has {before} messages, there is none at index {index}",
        where=str(recording.files[0]),
        hint="the first is at index 0",
    )


def topic_connections(
    recording: Recording, topic: str | None = None, *, msgtype: str | None = None
) -> list[Connection]:
    """Return the connections of a topic, or the connections with a message type.

    Raises:
        NothingMatched: No connection matches; the hint names the nearest topic or type.
    """
    connections = [
        one for one in recording.connections if topic in {None, one.topic} and msgtype in {None, one.msgtype}
    ]
    if connections:
        return connections
    name = topic or msgtype or ""
    names = sorted({one.topic if topic else one.msgtype for one in recording.connections})
    near = get_close_matches(name, names, n=1)
    raise NothingMatched(
        f"no topic {'is called' if topic else 'has the type'} {name}",
        where=str(recording.files[0]),
        hint=f"did you mean {near[0]}?" if near else f"there are {', '.join(names) or 'none'}",
    )


def _definition(connection: Connection) -> Definition:
    if connection.definition is None:
        raise BagError(
            connection.problem or f"no definition of {connection.msgtype} is known", where=connection.topic
        )
    return connection.definition


def _row(connection: Connection, message: MessageBlock) -> pa.StructArray:
    decoded = decoder_for(connection).decode(message)
    if decoded.failures:
        failure = decoded.failures[0]
        raise DecodeError(failure.reason, rule=failure.rule, where=connection.topic)
    return decoded.rows


class Known(Struct, frozen=True):
    """An adapter that a manifest can name."""

    name: str
    origin: str
    """`built-in`, or the entry point of the adapter."""
    default: bool
    ontology: str
    ros_types: tuple[str, ...]
    summary: str


class Explained(Struct, frozen=True):
    """The explanation of an adapter for one message type."""

    description: Description
    msgtype: str
    why: str
    """The rule that selects the adapter for the type; empty if the adapter itself was requested."""
    unread: tuple[str, ...]
    """Fields of the message that no expression uses."""
    others: tuple[str, ...]
    """Other adapters that accept the type if a topic names them."""


class TopicChoice(Struct, frozen=True):
    """The adapter of a topic, and the reason for it."""

    recording: str
    topic: str
    msgtype: str
    adapter: str
    """Empty for an excluded topic."""
    ontology: str
    why: str


class TestResult(Struct, frozen=True):
    """The result of testing one adapter file."""

    name: str
    file: str
    findings: tuple[Finding, ...]
    """Locations where the adapter does not fit one of its message types."""
    unknown: tuple[str, ...]
    """Message types without a known definition, against which the adapter could not be checked."""
    outcomes: tuple[CaseResult, ...]

    @property
    def passed(self) -> bool:
        """True if the adapter fits its types and every test has its expected result."""
        return not self.findings and all(outcome.passed for outcome in self.outcomes)


def find_adapter(reference: str) -> AdapterSpec:
    """Return an adapter by its name, file, or `module:Class`.

    Raises:
        AdapterError: There is none, or its file has a mistake.
    """
    installed = {spec.name: spec for _, spec in installed_adapters()}
    return installed.get(reference) or load_adapter_reference(reference, Path())


def known_adapters(takes: str | None = None) -> tuple[Known, ...]:
    """Return the installed and built-in adapters, limited to those for message types that match the glob `takes`.

    Raises:
        AdapterError: An installed package offers something that is no adapter.
    """
    every = [*installed_adapters(), *(("built-in", builtin) for builtin in BUILTIN)]
    return tuple(_known(origin, spec) for origin, spec in every if takes is None or _takes(spec, takes))


def _known(origin: str, spec: AdapterSpec) -> Known:
    words = describe(spec)
    return Known(spec.name, origin, spec.default, words.ontology, spec.ros_types, words.summary)


def _takes(spec: AdapterSpec, glob: str) -> bool:
    """Return whether a glob matches one of the adapter's types in its full, short or bare name."""
    spellings = ((name, short_msgtype(name), name.rpartition("/")[2]) for name in spec.ros_types)
    return any(fnmatchcase(spelling, glob) for names in spellings for spelling in names)


def source_text(spec: AdapterSpec) -> str:
    """Return the text of an adapter file.

    Raises:
        AdapterError: It is written in Python.
    """
    mapping = mapping_of(spec)
    if mapping is None:
        raise AdapterError(
            f"{spec.name} is written in Python, not in YAML",
            hint=f"try `ingest adapters explain {spec.name}`",
        )
    return mapping.source.text


def explain_adapter(reference: str, types: DefinitionFinder) -> Explained:
    """Explain an adapter, or the default adapter of a message type.

    Raises:
        AdapterError: There is no such adapter, or a type without one.
    """
    if _is_type(reference):
        msgtype = normalize_msgtype(reference)
        choice = ROSBridge().resolve("", msgtype)
        spec, why = choice.spec, choice.why
    else:
        spec, why = find_adapter(reference), ""
        msgtype = spec.ros_types[0] if spec.ros_types else ""
    others = tuple(
        adapter.name
        for adapter in known_adapters(msgtype)
        if adapter.name != spec.name and msgtype in adapter.ros_types
    )
    return Explained(describe(spec, msgtype), msgtype, why, _unread(spec, msgtype, types), others)


def _is_type(reference: str) -> bool:
    """Return whether a reference is a type, such as `sensor_msgs/Imu` or `foxglove.Log`, and not an adapter."""
    is_name = ":" not in reference and not reference.endswith(_FILES)
    return is_name and ("/" in reference or "." in reference)


def _unread(spec: AdapterSpec, msgtype: str, types: DefinitionFinder) -> tuple[str, ...]:
    """Return the fields of a type that an adapter does not read.

    A protobuf or JSON type is in no distro; it has the fields of the adapter's first type.
    """
    for name in (msgtype, *spec.ros_types[:1]):
        with suppress(BagError):
            definition = types.find(name, spec)
            shape = ros_shape(definition)
            return unread_fields(spec.bind(definition, shape), shape)
    return ()


def explain_topics(
    *, job: Path | None, bag: Path | None, distro: str | None = None, custom: Sequence[CustomMessages] = ()
) -> tuple[TopicChoice, ...]:
    """Return the adapter of each topic of a job's recordings or of one recording, with the reason.

    Raises:
        IngestError: The job cannot be done; the message states the reason.
    """
    if job is not None:
        jobs = compile_manifest(load_manifest(job))
    else:
        config = ROSInjectionConfig(
            file_path=bag or Path(), sequence_name="explained", ros_distro=distro, custom_msgs=custom
        )
        jobs = (config.job,)
    return tuple(choice for each in jobs for choice in _choices(each))


def _choices(job: Job) -> Iterator[TopicChoice]:
    plan = make_plan(Task(job))
    name = ", ".join(path.name for path in plan.files)
    choices = [
        TopicChoice(name, one.topic, one.msgtype, one.adapter.name, one.ontology.tag, one.why)
        for one in plan.topics
    ]
    choices += [TopicChoice(name, one.topic, one.msgtype, "", "", one.why) for one in plan.excluded]
    yield from sorted(choices, key=lambda one: one.topic)


def run_adapter_tests(spec: AdapterSpec, types: DefinitionFinder) -> TestResult:
    """Check an adapter file against its message types, and run its tests; paths of recordings start at its folder.

    Raises:
        AdapterError: It is written in Python.
    """
    mapping = mapping_of(spec)
    if mapping is None:
        raise AdapterError(
            f"{spec.name} is written in Python; only an adapter file carries tests",
            hint="test it with pytest",
        )
    folder = Path(mapping.source.file).parent

    def recorded(message: RecordedMessage) -> tuple[Definition, pa.StructArray, Envelope]:
        return message_in(folder / message.bag, message.topic, message.index, resolve=types)

    findings: dict[Finding, None] = {}
    unknown: list[str] = []
    for msgtype in mapping.ros_types:
        try:
            definition = types.find(msgtype, spec)
        except BagError:  # noqa: PERF203 - each type may be unknown for itself
            unknown.append(msgtype)
        else:
            findings |= dict.fromkeys(mapping.check(definition, ros_shape(definition)))
    outcomes = () if findings else run_tests(mapping, types, recorded=recorded)
    file = str(spec.path) if isinstance(spec, Builtin) else mapping.source.file
    return TestResult(spec.name, file, tuple(findings), tuple(unknown), outcomes)


def draft_adapter(
    msgtype: str,
    types: DefinitionFinder,
    *,
    bag: Path | None = None,
    job: Path | None = None,
    record: str | None = None,
    ontology: str | None = None,
    folder: Path = Path(),
) -> str:
    """Return a draft of an adapter file for `folder`.

    The recording `bag`, or the first recording of the manifest `job`, supplies the type's definition; `record` names a
    topic, and the draft tests its first message.

    Raises:
        BagError: The definition is not known, or the recording cannot be read.
        NothingMatched: The recording has no such type or topic.
        AdapterError: The type has no fields, the topic has another type, or there is no such ontology.
    """
    name = normalize_msgtype(msgtype)
    if bag is None and job is None:
        definition = types.find(name)
        return draft(definition, ontology=ontology, embed=definition.source is not Source.DISTRO)
    example = None
    with _recording(bag, job, types) as (path, recording):
        if record is None:
            definition = _definition(topic_connections(recording, msgtype=name)[0])
        else:
            definition, row, _ = _message_in(recording, record)
            example = RecordedExample(
                row, {"bag": path if "://" in path else relpath(path, folder), "topic": record, "index": 0}
            )
            if definition.root != name:
                raise AdapterError(
                    f"the topic has the type {definition.root}, not {name}",
                    where=record,
                    hint="name another topic",
                )
    return draft(definition, ontology=ontology, embed=not _in_distros(definition), example=example)


@contextmanager
def _recording(
    bag: Path | None, job: Path | None, types: DefinitionFinder
) -> Generator[tuple[str, Recording]]:
    """Open a recording, or the first recording of a manifest with the definitions that the manifest adds."""
    if job is None:
        with open_recording(bag or Path(), resolve=types) as recording:
            yield str(bag), recording
        return
    first = compile_manifest(load_manifest(job))[0]
    with open_job(first) as (recording, _):
        yield str(first.paths[0]), recording


def _in_distros(definition: Definition) -> bool:
    """Return whether a distro has the same type, so that the adapter file does not need to embed it."""
    try:
        distro_definition = DefinitionFinder().find(definition.root)
    except BagError:
        return False
    return replace(distro_definition.message, constants=()) == replace(definition.message, constants=())


class TriedMessage(Struct, frozen=True):
    """A message, and the rows or the rejection that an adapter derives from it."""

    index: int
    """Position in the topic, from 0."""
    log_time_ns: int
    message: dict[str, Any]
    """The fields of the message; empty if it cannot be decoded."""
    rows: dict[str, list[dict[str, Any]]]
    """The rows by output; the output of an adapter without `outputs` has an empty name."""
    rejected: str | None = None
    """The rule and the reason for the rejection of the message."""
    dropped: str | None = None
    """The rule that drops the message."""


def try_adapter(
    spec: AdapterSpec,
    bag: Path,
    topic: str,
    count: int,
    *,
    resolve: Resolver,
    parameters: dict[str, Scalar] | None = None,
) -> tuple[TriedMessage, ...]:
    """Convert the first messages of a topic; no message is stored.

    Raises:
        BagError: The recording cannot be opened, or the definition of the topic is not known.
        NothingMatched: There is no such topic, or it has no messages.
        AdapterError: The adapter does not fit the type of the topic, or has no such parameter.
    """
    if parameters:
        if not isinstance(spec, MappingSpec):
            raise AdapterError(f"{spec.name} has no parameters", hint="remove --with")
        spec = spec.with_parameters(parameters)
    tried: list[TriedMessage] = []
    with open_recording(bag, resolve=resolve) as recording:
        connections = {one.id: one for one in topic_connections(recording, topic)}
        adapters = {key: _bound(spec, one) for key, one in connections.items()}
        names = [output.output for output in outputs_of(spec)] or [""]
        for block in recording.message_blocks(list(connections), max_rows=_TRIAL_ROWS):
            part = block.rows(slice(0, count - len(tried)))
            connection = connections[block.connection]
            tried += _tried(part, connection, adapters[block.connection], names, first=len(tried))
            if len(tried) == count:
                break
    if not tried:
        raise NothingMatched("the topic has no messages", where=topic, hint="name another topic")
    return tuple(tried)


def _bound(spec: AdapterSpec, connection: Connection) -> Adapter:
    if connection.definition is None:
        raise BagError(
            connection.problem or f"no definition of {connection.msgtype} is known", where=connection.topic
        )
    return spec.bind(connection.definition, ros_shape(connection.definition))


def _tried(
    block: MessageBlock, connection: Connection, adapter: Adapter, names: list[str], *, first: int
) -> list[TriedMessage]:
    decoded = decoder_for(connection).decode(block)
    envelope = Envelope(
        connection.topic, connection.msgtype, block.log_times, block.publish_times, block.sequences
    ).take(decoded.index)
    adapted = adapter.adapt(decoded.rows, envelope)
    values = cast("Any", decoded.rows).to_pylist()  # the stubs lack to_pylist of struct arrays
    messages = dict(zip(decoded.index.tolist(), values, strict=True))
    rejected = {failure.row: f"[{failure.rule}] {failure.reason}" for failure in decoded.failures}
    rejected |= {
        int(decoded.index[failure.row]): f"[{failure.rule}] {failure.reason}" for failure in adapted.failures
    }
    dropped = {
        int(decoded.index[row]): rule for rule, rows in adapted.dropped.items() for row in rows.tolist()
    }
    rows = {
        name: _rows_of(output, decoded.index)
        for name, output in zip(names, (adapted, *adapted.others), strict=False)
    }
    return [
        TriedMessage(
            first + at,
            int(block.log_times[at]),
            messages.get(at, {}),
            {name: of_output.get(at, []) for name, of_output in rows.items()},
            rejected.get(at),
            dropped.get(at),
        )
        for at in range(len(block))
    ]


def _rows_of(adapted: Adapted, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> dict[int, list[Any]]:
    """Return the rows of each message that has any, by the position of the message in the block."""
    rows: dict[int, list[Any]] = {}
    values: Any = adapted.rows  # the stubs lack to_pylist of struct arrays
    for message, row in zip(index[adapted.index].tolist(), values.to_pylist(), strict=True):
        rows.setdefault(message, []).append(row)
    return rows
