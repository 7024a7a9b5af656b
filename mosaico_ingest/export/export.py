"""Export of a sequence: restores the messages of each topic and writes them to a recording in time order."""

from __future__ import annotations

import heapq
import logging
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path, PurePath
from typing import Any

import pyarrow as pa
from msgspec import Struct
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope, UnmodeledSpec, recorded_schema
from mosaico_ingest.adapters.bridge import ROSBridge, adapter_spec, outputs_of
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.adapters.inverse import Inverse, Restored, invert
from mosaico_ingest.adapters.mapping.columns import struct_of
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, MappingSpec
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.containers import ROS_VERSIONS
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.model import AttachmentInfo
from mosaico_ingest.errors import AdapterError, BagError, IngestError, NothingMatched
from mosaico_ingest.export.sources import SourceSequence, SourceTopic, StoreSequence, as_type, comparable
from mosaico_ingest.findings import join_names, suggest_names
from mosaico_ingest.job.values import CUSTOM_DATA_KEY, RECORDS_KEY, Stores, select
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.rosbag.blocks import Attachment
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Language, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, ROSTypeRegistry, TypeResolver, store_of
from mosaico_ingest.rosbag.encodings import MESSAGE_ENCODINGS, encoding_of
from mosaico_ingest.rosbag.rosbags_library import (
    AttachmentWriter,
    RecordingWriter,
    check_new_recording,
    open_writer,
)

_log = logging.getLogger(__name__)
_TIME_1 = re.compile(r"^(?:time|duration)(?:\[\d*\])?\s", re.MULTILINE)
_TIME_2 = re.compile(r"^builtin_interfaces/(?:Time|Duration)(?:\[[<=\d]*\])?\s", re.MULTILINE)
_ROWS = 1000
"""Number of messages that are restored together."""
Message = tuple[int, bytes]
"""Log time in nanoseconds, and payload."""
_READ_BYTES = 1 << 20


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class TopicExport(_Record):
    """The result of the export of one topic."""

    topic: str
    msgtype: str = ""
    """The message type, `pkg/msg/Name`; empty if the topic's metadata does not contain it."""
    ontology: str
    adapter: str = ""
    """The adapter that was inverted; `Unmodeled` if the rows are stored in the ROS shape."""
    messages: int = 0
    assumed: str = ""
    """The type and the distro of the definition, if the topic's metadata does not contain one."""
    defaulted: tuple[str, ...] = ()
    """Message fields that the store does not contain; in every message, they are absent, or zero, empty or false."""
    not_invertible: dict[str, str] = {}
    """Columns whose expression cannot be inverted, with the expression."""
    changed: dict[str, int] = {}
    """Columns that would differ if the file were ingested, with the number of rows."""
    excluded: str = ""
    """The reason why the topic is not in the file; empty if it is."""
    rule: str = ""
    """The id of the rule for the exclusion, such as `no-inverse`; empty if there is none."""
    location: str = ""
    """File, line and column of the cause, if an adapter file is the cause."""

    @property
    def exclusion(self) -> str:
        """The reason for the exclusion with its location and rule id, as findings are printed."""
        return f"{self.location}: warning[{self.rule}] {self.excluded}" if self.rule else self.excluded

    @property
    def faithful(self) -> bool:
        """Whether ingesting the file with the same job gives the same rows."""
        return not self.excluded and not self.changed


class ExportReport(_Record):
    """The result of one export."""

    sequence: str
    path: str
    bytes: int
    topics: tuple[TopicExport, ...]
    omitted: tuple[str, ...] = ()
    """Attachments, metadata records and `custom_data` that the container cannot store, one line for each kind."""

    @property
    def messages(self) -> int:
        """The number of messages in the file."""
        return sum(topic.messages for topic in self.topics)

    @property
    def faithful(self) -> bool:
        """Whether the file contains every topic and all else that the sequence keeps, and gives the same rows."""
        return not self.omitted and all(topic.faithful for topic in self.topics)


class Origin(Struct, frozen=True):
    """The original messages of a topic: type, definition and source file."""

    msgtype: str
    text: str
    """The definition with its dependencies."""
    source_file: str
    language: Language = Language.ROS

    @property
    def version(self) -> int | None:
        """The version of ROS that the definition requires; None if it fits both, because it contains no time."""
        if self.language is not Language.ROS:
            return None
        return 1 if _TIME_1.search(self.text) else 2 if _TIME_2.search(self.text) else None

    def definition(self, version: int) -> Definition:
        """Return the parsed definition; `version` is the version of ROS of a ROS definition.

        Raises:
            BagError: The text is not a valid definition.
        """
        entry = next(
            encoding for encoding in MESSAGE_ENCODINGS.values() if encoding.language is self.language
        )
        if entry.read_schema is not None:
            schema = Embedded(entry.schema_encoding, self.text) if self.text else None
            return entry.read_schema(self.msgtype, schema)
        embedded = Embedded(f"ros{version}msg", self.text)
        return TypeResolver(Stores.EMPTY).resolve(self.msgtype, embedded, ros_version=version)


def origin_of(topic: SourceTopic) -> Origin | None:
    """Return the original messages of a topic, or None if its metadata does not describe them."""
    schema = recorded_schema(topic.metadata)
    if schema is None:
        return None
    return Origin(schema.msgtype, schema.text, schema.source_file, schema.language)


def version_of(origin: Origin, others: Sequence[Origin], possible: Collection[int]) -> int:
    """Return the version of ROS of a topic: that of its definition, or of another topic of the same recording."""
    versions = [each.version for each in (origin, *others) if each.source_file == origin.source_file]
    version = next((version for version in versions if version is not None), None)
    if version is None:
        version = 1 if PurePath(origin.source_file).suffix == ".bag" else 2
    return version if version in possible or origin.version is not None else min(possible)


@dataclass(slots=True)
class Restorer:
    """The restorer of the messages of one topic; it counts missing fields and differing rows."""

    info: SourceTopic
    definition: Definition
    adapter: str
    ontology: OntologyType
    """The type of the rows that the adapter produces."""
    inverse: Inverse
    assumed: str = ""
    """The type and the distro of the definition, if the topic's metadata does not contain one."""
    messages: int = 0
    _defaulted: dict[str, None] = field(default_factory=dict[str, None])
    _not_invertible: dict[str, str] = field(default_factory=dict[str, str])
    _changed: Counter[str] = field(default_factory=Counter[str])

    def read(self, batches: Iterator[pa.RecordBatch]) -> Iterator[Message]:
        """Yield the messages of the topic in the order of the rows.

        Raises:
            BagError: A value does not fit its message field.
        """
        serializer = MESSAGE_ENCODINGS[encoding_of(self.definition)].writer(self.definition)
        for log_ns, values in self.read_values(batches):
            yield log_ns, serializer.from_dict(values)

    def read_values(self, batches: Iterator[pa.RecordBatch]) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the log time and the fields of each message of the topic in the order of the rows."""
        for batch in batches:
            all_times: Any = batch.column("timestamp_ns").to_numpy()
            all_rows = self._rows(batch)
            for start in range(0, batch.num_rows, _ROWS):
                times = all_times[start : start + _ROWS]
                restored = self._restore(all_rows.slice(start, _ROWS), times)
                self._count(restored)
                array: Any = restored.rows  # the stubs lack to_pylist of struct arrays
                yield from zip(times.tolist(), array.to_pylist(), strict=True)

    def result(self) -> TopicExport:
        """Return the result so far."""
        return TopicExport(
            topic=self.info.name,
            msgtype=self.definition.root,
            ontology=self.info.ontology.tag,
            adapter=self.adapter,
            assumed=self.assumed,
            messages=self.messages,
            defaulted=tuple(self._defaulted),
            not_invertible=dict(self._not_invertible),
            changed=dict(self._changed),
        )

    def trial(self, batch: pa.RecordBatch) -> tuple[int, int]:
        """Return how many values of a first batch would differ, and how many fields it does not define."""
        times: Any = batch.column("timestamp_ns").to_numpy()
        restored = self._restore(self._rows(batch).slice(0, _ROWS), times[:_ROWS])
        differing = sum((restored.changed or {}).values()) + len(restored.not_invertible or {})
        return differing, len(restored.defaulted)

    def _rows(self, batch: pa.RecordBatch) -> pa.StructArray:
        columns = [
            as_type(batch.column(field.name), field.type, field.name) for field in self.ontology.struct
        ]
        return struct_of(columns, self.ontology.struct, None, batch.num_rows)

    def _restore(self, rows: pa.StructArray, times: Any) -> Restored:  # noqa: ANN401 - an array of numpy
        return self.inverse.restore(rows, Envelope(self.info.name, self.definition.root, times))

    def _count(self, restored: Restored) -> None:
        self.messages += len(restored.rows)
        self._defaulted.update(dict.fromkeys(restored.defaulted))
        self._not_invertible.update(restored.not_invertible or {})
        self._changed.update(restored.changed or {})


def restorer_for(info: SourceTopic, definition: Definition, specs: Sequence[AdapterSpec]) -> Restorer:
    """Return the restorer of a topic, which inverts the first adapter that produces the topic's columns.

    Raises:
        AdapterError: No adapter produces these columns, or it cannot be inverted.
    """
    shape = ros_shape(definition)
    mismatches: list[str] = []
    candidates = _candidates(info, definition, specs)
    for spec in chain.from_iterable(outputs_of(candidate) or (candidate,) for candidate in candidates):
        try:
            adapter = spec.bind(definition, shape)
        except AdapterError as error:
            mismatches.append(error.what)
            continue
        if _produces(adapter, info):
            if isinstance(spec, MappingSpec) and isinstance(adapter, MappingAdapter):
                _check_inverse(spec, adapter)
            inverse = invert(adapter, definition, info.metadata)
            return Restorer(info, definition, spec.name, adapter.ontology, inverse)
    raise AdapterError(
        f"no known adapter converts {definition.root} to {info.ontology.tag}",
        hint=mismatches[0] if mismatches else "select the adapter of the topic with --adapter",
    )


def _check_inverse(spec: MappingSpec, adapter: MappingAdapter) -> None:
    """Raise an error with the location in the adapter file if the adapter has no inverse."""
    if finding := spec.inverse_finding(adapter):
        raise AdapterError(finding.message, where=str(finding.span), findings=(finding,))


def _candidates(
    info: SourceTopic, definition: Definition, specs: Sequence[AdapterSpec]
) -> Iterator[AdapterSpec]:
    """Yield the adapters that can have produced a topic: the named ones, the default one, other built-in ones."""
    msgtype = normalize_msgtype(definition.root)
    yield from (spec for spec in specs if not spec.ros_types or msgtype in spec.ros_types)
    yield ROSBridge().resolve(info.name, msgtype).spec
    yield from (spec for spec in BUILTIN if msgtype in spec.ros_types)
    yield UnmodeledSpec(serialization_format=info.ontology.serialization_format)


def _produces(adapter: Adapter, info: SourceTopic) -> bool:
    ontology = adapter.ontology
    return (ontology.tag, comparable(ontology.struct)) == (
        info.ontology.tag,
        comparable(info.ontology.struct),
    )


class Definitions(Struct, frozen=True):
    """The definitions of topics that were stored without one."""

    distro: Stores
    finder: DefinitionFinder


def _assumed_restorer(
    source: SourceSequence, info: SourceTopic, specs: Sequence[AdapterSpec], definitions: Definitions
) -> Restorer | None:
    """Return the restorer of a topic whose metadata has no definition, or None if no adapter produces its columns.

    The message type is the one of an adapter's types, as defined by the distro, that changes the fewest values of the first rows.
    """
    version = 1 if definitions.distro.value.startswith("ros1") else 2
    restorers: list[Restorer] = []
    for spec in (*specs, *(spec for spec in BUILTIN if spec.tag == info.ontology.tag)):
        for msgtype in spec.ros_types:
            with suppress(AdapterError, BagError):
                definition = definitions.finder.find(msgtype, spec)
                adapter = spec.bind(definition, ros_shape(definition))
                if definition.ros_version == version and _produces(adapter, info):
                    inverse = invert(adapter, definition, info.metadata)
                    assumed = f"{definition.root} of {definitions.distro.value}"
                    restorers.append(
                        Restorer(info, definition, spec.name, adapter.ontology, inverse, assumed)
                    )
    if len(restorers) < 2:  # noqa: PLR2004 - nothing to choose
        return restorers[0] if restorers else None
    with closing(source.rows(info)) as batches:
        first = next(batches, None)
    return restorers[0] if first is None else min(restorers, key=lambda restorer: restorer.trial(first))


def export_sequence(
    source: Store | SourceSequence,
    sequence: str,
    path: Path | str,
    *,
    topics: Sequence[str] = (),
    start_ns: int | None = None,
    end_ns: int | None = None,
    adapters: Sequence[str] = (),
    ros_distro: Stores | str | None = None,
    custom_msgs: Sequence[CustomMessages] = (),
    registry: type[ROSTypeRegistry] = ROSTypeRegistry,
    replace: bool = False,
    dry_run: bool = False,
) -> ExportReport:
    """Write a sequence, or the selected topics and time range of it, to a recording.

    `source` is a store, or a sequence of another source, such as `sources.ServerSequence`. The suffix of the file selects the
    container: `.mcap`, `.db3` (ROS 2) or `.bag` (ROS 1). `start_ns` is inclusive, `end_ns` exclusive. `ros_distro` defines the
    message types of topics whose metadata has no definition; it defaults to the newest distro that the container can store, and
    `custom_msgs` and `registry` add types. With `dry_run`, no message is read and no file is written.

    Raises:
        NothingMatched: No topic or message is selected, or no topic can be exported.
        BagError: The file already exists, or it cannot be written.
        SinkError: The sequence does not exist or cannot be read.
        AdapterError: One of `adapters` cannot be loaded.
    """
    path = Path(path)
    check_new_recording(path, replace=replace)
    opened = StoreSequence(source, sequence) if isinstance(source, Store) else source
    default = Stores.LATEST if 2 in ROS_VERSIONS[path.suffix] else Stores.ROS1_NOETIC  # noqa: PLR2004 - ROS 2
    distro = store_of(ros_distro) or default
    definitions = Definitions(distro, DefinitionFinder(distro, custom_msgs, registry))
    specs = [adapter_spec(reference, Path()) for reference in adapters]
    candidates = restorers_of(opened, topics, definitions, specs=specs, versions=ROS_VERSIONS[path.suffix])
    if dry_run:
        results = [
            candidate.result() if isinstance(candidate, Restorer) else candidate for candidate in candidates
        ]
        return _logged(ExportReport(sequence=sequence, path=str(path), bytes=0, topics=tuple(results)))
    with open_writer(path, replace=replace) as writer:
        restorers: list[tuple[int, Restorer]] = []
        excluded: list[TopicExport] = []
        for restorer in candidates:
            outcome = _connected(restorer, writer) if isinstance(restorer, Restorer) else restorer
            if isinstance(outcome, TopicExport):
                excluded.append(outcome)
            else:
                restorers.append(outcome)
        if not restorers:
            raise NothingMatched(
                f"none of the {len(excluded)} selected topics can be exported",
                where=sequence,
                hint=_first_reason(excluded),
            )
        omitted = write_kept(opened, writer)
        messages = [
            _messages(opened, connection, restorer, start_ns, end_ns) for connection, restorer in restorers
        ]
        for log_ns, connection, payload in heapq.merge(*messages, key=lambda message: message[0]):
            writer.write(connection, log_ns, payload)
        if not any(restorer.messages for _, restorer in restorers):
            raise NothingMatched(
                "no message is in the selected time range", where=sequence, hint="check --start and --end"
            )
    results = [*(restorer.result() for _, restorer in restorers), *excluded]
    results.sort(key=lambda result: result.topic)
    size = path.stat().st_size
    return _logged(
        ExportReport(sequence=sequence, path=str(path), bytes=size, topics=tuple(results), omitted=omitted)
    )


def _logged(report: ExportReport) -> ExportReport:
    """Log the topics of a report, the unfaithful ones as warnings, and return the report."""
    for line in report.omitted:
        _log.warning("%s: the file cannot contain %s", report.sequence, line)
    for topic in report.topics:
        if topic.excluded:
            _log.warning("%s of %s is not exported: %s", topic.topic, report.sequence, topic.exclusion)
            continue
        for column, count in topic.changed.items():
            _log.warning("%s of %s: %s differs in %s messages", topic.topic, report.sequence, column, count)
        _log.info("%s of %s: exported %s messages", topic.topic, report.sequence, topic.messages)
    return report


def _selected(sequence: SourceSequence, patterns: Sequence[str]) -> tuple[SourceTopic, ...]:
    names = [topic.name for topic in sequence.topics]
    selection = select(patterns, names)
    if not selection.selected:
        problem = (
            f"no topic matches {', '.join(map(repr, patterns))}" if names else "the sequence has no topics"
        )
        raise NothingMatched(
            problem, where=sequence.name, hint=suggest_names(names, patterns) if names else None
        )
    return tuple(topic for topic in sequence.topics if topic.name in selection.selected)


def restorers_of(
    source: SourceSequence,
    patterns: Sequence[str],
    definitions: Definitions,
    *,
    specs: Sequence[AdapterSpec] = (),
    versions: Collection[int] = (1, 2),
) -> list[Restorer | TopicExport]:
    """Return the restorer of each selected topic, or the reason why the topic cannot be restored.

    `versions` are the possible versions of ROS of the messages.

    Raises:
        NothingMatched: No topic is selected.
    """
    selected = _selected(source, patterns)
    return [
        _restorer(source, info, selected, specs, versions=versions, definitions=definitions)
        for info in selected
    ]


def _restorer(
    source: SourceSequence,
    info: SourceTopic,
    selected: Sequence[SourceTopic],
    specs: Sequence[AdapterSpec],
    *,
    versions: Collection[int],
    definitions: Definitions,
) -> Restorer | TopicExport:
    """Return the restorer of a topic, or the reason why the topic cannot be exported."""
    if info.problem:
        return _excluded(info, "", info.problem)
    origin = origin_of(info)
    if origin is None:
        restorer = _assumed_restorer(source, info, specs, definitions)
        reason = "its metadata does not describe the original messages"
        return restorer or _excluded(info, "", f"{reason}, and no adapter produces {info.ontology.tag}")
    others = [other for topic in selected if (other := origin_of(topic)) is not None]
    version = version_of(origin, others, versions)
    try:
        return restorer_for(info, origin.definition(version), specs)
    except (AdapterError, BagError) as error:
        excluded = _excluded(info, origin.msgtype, _reason(error))
        finding = next(iter(error.findings), None)
        if finding is None:
            return excluded
        return excluded.model_copy(update={"rule": finding.rule, "location": str(finding.span or "")})


def _connected(restorer: Restorer, writer: RecordingWriter) -> tuple[int, Restorer] | TopicExport:
    """Add the connection of a topic, or return the reason why the container does not accept it."""
    try:
        return writer.add_connection(restorer.info.name, restorer.definition), restorer
    except (AdapterError, BagError) as error:
        return _excluded(restorer.info, restorer.definition.root, _reason(error))


def _reason(error: IngestError) -> str:
    return f"{error.what} — {error.hint}" if error.hint else error.what


def _excluded(info: SourceTopic, msgtype: str, reason: str) -> TopicExport:
    return TopicExport(topic=info.name, msgtype=msgtype, ontology=info.ontology.tag, excluded=reason)


def _first_reason(excluded: Sequence[TopicExport]) -> str:
    return f"{excluded[0].topic}: {excluded[0].exclusion}"


def _messages(
    source: SourceSequence, connection: int, restorer: Restorer, start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[int, int, bytes]]:
    with closing(source.rows(restorer.info, start_ns, end_ns)) as batches:
        for log_ns, payload in restorer.read(batches):
            yield log_ns, connection, payload


def write_kept(source: SourceSequence, writer: RecordingWriter) -> tuple[str, ...]:
    """Write metadata records, `custom_data` and attachments; return one line for each kind that the file cannot contain.

    Raises:
        BagError: An attachment cannot be read.
    """
    omitted: list[str] = []
    records = dict(_pairs(source.metadata, RECORDS_KEY))
    custom_data = {str(key): str(value) for key, value in _entries(source.metadata.get(CUSTOM_DATA_KEY))}
    if isinstance(writer, AttachmentWriter):
        for name, entries in records.items():
            writer.add_metadata(name, entries)
        for attachment in source.attachments:
            writer.add_attachment(_attachment(attachment), _chunks(attachment))
    else:
        if records:
            omitted.append(f"metadata records: {join_names(records)}")
        if source.attachments:
            omitted.append(f"attachments: {join_names(each.name for each in source.attachments)}")
    if custom_data:
        try:
            writer.set_custom_data(custom_data)
        except BagError:
            omitted.append(f"custom_data: {join_names(custom_data)}")
    return tuple(omitted)


def _pairs(metadata: Mapping[str, Any], key: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Yield the name and the entries of each metadata record; values in another form are ignored."""
    records = metadata.get(key)
    for record in records if isinstance(records, list) else ():
        if isinstance(record, dict) and isinstance(record.get("name"), str):
            yield record["name"], _entries(record.get("entries"))


def _entries(value: object) -> list[tuple[str, str]]:
    pairs = (entry for entry in (value if isinstance(value, list) else ()) if isinstance(entry, list))
    return [(str(pair[0]), str(pair[1])) for pair in pairs if len(pair) == len(("key", "value"))]


def _attachment(info: AttachmentInfo) -> Attachment:
    return Attachment(
        info.name, info.media_type, info.log_ns, info.create_ns, info.stored_bytes, has_crc=True
    )


def _chunks(info: AttachmentInfo) -> Iterator[bytes]:
    try:
        with info.path.open("rb") as file:
            while chunk := file.read(_READ_BYTES):
                yield bytes(chunk)
    except OSError as error:
        raise BagError(f"the attachment cannot be read: {error.strerror}", where=str(info.path)) from error
