"""Export of a sequence of the store to a recording, with a report of its fidelity.

The messages of each topic are restored and written in time order. Every restored batch is adapted again and compared
with the stored rows; the report lists each difference and each excluded topic. The module must not depend on the pipeline.
"""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, cast

import pyarrow as pa
from msgspec import Struct
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.adapters.adapter import ROS_METADATA_KEY, Adapter, AdapterSpec, Envelope, UnmodeledSpec
from mosaico_ingest.adapters.bridge import ROSBridge, adapter_spec
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.adapters.inverse import Inverse, Restored, invert
from mosaico_ingest.adapters.mapping.columns import struct_of
from mosaico_ingest.destinations.store import SequenceInfo, Store, TopicInfo
from mosaico_ingest.errors import AdapterError, BagError, NothingMatched
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.patterns import select
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.formats import ROS_VERSIONS
from mosaico_ingest.rosbag.serialization import Serializer
from mosaico_ingest.rosbag.writers import RecordingWriter, open_writer


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
    defaulted: tuple[str, ...] = ()
    """Message fields that the store does not contain; they are zero, empty or false in every message."""
    not_invertible: dict[str, str] = {}
    """Columns whose expression cannot be inverted, with the expression."""
    changed: dict[str, int] = {}
    """Columns that would differ if the file were ingested, with the number of rows."""
    excluded: str = ""
    """The reason why the topic is not in the file; empty if it is."""

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

    @property
    def messages(self) -> int:
        """The number of messages in the file."""
        return sum(topic.messages for topic in self.topics)

    @property
    def faithful(self) -> bool:
        """Whether the file contains every topic and gives the same rows."""
        return all(topic.faithful for topic in self.topics)


_TIME_1 = re.compile(r"^(?:time|duration)(?:\[\d*\])?\s", re.MULTILINE)
_TIME_2 = re.compile(r"^builtin_interfaces/(?:Time|Duration)(?:\[[<=\d]*\])?\s", re.MULTILINE)


class Origin(Struct, frozen=True):
    """The original messages of a topic: type, definition and source file."""

    msgtype: str
    text: str
    """The definition with its dependencies."""
    source_file: str

    @property
    def version(self) -> int | None:
        """The version of ROS that the definition requires; None if it fits both, because it contains no time."""
        return 1 if _TIME_1.search(self.text) else 2 if _TIME_2.search(self.text) else None

    def definition(self, version: int) -> Definition:
        """Return the parsed definition for a version of ROS.

        Raises:
            BagError: The text is not a valid definition.
        """
        embedded = Embedded(f"ros{version}msg", self.text)
        return TypeResolver(Stores.EMPTY).resolve(self.msgtype, embedded, ros_version=version)


def origin_of(topic: TopicInfo) -> Origin | None:
    """Return the original messages of a topic, or None if its metadata does not describe them."""
    metadata = topic.metadata.get(ROS_METADATA_KEY)
    if not isinstance(metadata, dict):
        return None
    values = cast("Mapping[str, Any]", metadata)
    fields = [values.get(key, "") for key in ("msgtype", "msgdef", "source_file")]
    if not all(isinstance(value, str) for value in fields) or not fields[0]:
        return None
    return Origin(*fields)


def version_of(origin: Origin, others: Sequence[Origin], possible: Collection[int]) -> int:
    """Return the version of ROS of a topic: that of its definition, or of another topic of the same recording."""
    versions = [each.version for each in (origin, *others) if each.source_file == origin.source_file]
    version = next((version for version in versions if version is not None), None)
    if version is None:
        version = 1 if PurePath(origin.source_file).suffix == ".bag" else 2
    return version if version in possible or origin.version is not None else min(possible)


_ROWS = 1000
"""Number of messages that are restored together."""

Message = tuple[int, bytes]
"""Log time in nanoseconds, and payload."""


@dataclass(slots=True)
class Restorer:
    """The restorer of the messages of one topic; it counts missing fields and differing rows."""

    info: TopicInfo
    definition: Definition
    adapter: str
    inverse: Inverse
    messages: int = 0
    _defaulted: dict[str, None] = field(default_factory=dict[str, None])
    _not_invertible: dict[str, str] = field(default_factory=dict[str, str])
    _changed: Counter[str] = field(default_factory=Counter[str])

    def read(self, batches: Iterator[pa.RecordBatch]) -> Iterator[Message]:
        """Yield the messages of the topic in the order of the rows.

        Raises:
            BagError: A value does not fit its message field.
        """
        encoding = Encoding.ROS1 if self.definition.ros_version == 1 else Encoding.CDR
        serializer = Serializer(self.definition, encoding)
        for batch in batches:
            for start in range(0, batch.num_rows, _ROWS):
                rows_batch = batch.slice(start, _ROWS)
                times: Any = rows_batch.column(0).to_numpy()
                rows = struct_of(rows_batch.columns[1:], self.info.ontology.struct, None, rows_batch.num_rows)
                envelope = Envelope(self.info.name, self.definition.root, times)
                restored = self.inverse.restore(rows, envelope)
                self._count(restored)
                array: Any = restored.rows  # the stubs lack to_pylist of struct arrays
                values = array.to_pylist()
                yield from zip(times.tolist(), map(serializer.from_dict, values), strict=True)

    def result(self) -> TopicExport:
        """Return the result so far."""
        return TopicExport(
            topic=self.info.name,
            msgtype=self.definition.root,
            ontology=self.info.ontology.tag,
            adapter=self.adapter,
            messages=self.messages,
            defaulted=tuple(self._defaulted),
            not_invertible=dict(self._not_invertible),
            changed=dict(self._changed),
        )

    def _count(self, restored: Restored) -> None:
        self.messages += len(restored.rows)
        self._defaulted.update(dict.fromkeys(restored.defaulted))
        self._not_invertible.update(restored.not_invertible or {})
        self._changed.update(restored.changed or {})


def restorer_for(info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]) -> Restorer:
    """Return the restorer of a topic, which inverts the first adapter that produces the topic's columns.

    Raises:
        AdapterError: No adapter produces these columns, or it cannot be inverted.
    """
    shape = ros_shape(definition)
    mismatches: list[str] = []
    for spec in _candidates(info, definition, specs):
        try:
            adapter = spec.bind(definition, shape)
        except AdapterError as error:
            mismatches.append(error.what)
            continue
        if _produces(adapter, info):
            inverse = invert(adapter, shape, info.metadata)
            return Restorer(info, definition, spec.name, inverse)
    raise AdapterError(
        f"no known adapter converts {definition.root} to {info.ontology.tag}",
        hint=mismatches[0] if mismatches else "select the adapter of the topic with --adapter",
    )


def _candidates(
    info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]
) -> Iterator[AdapterSpec]:
    """Yield the adapters that can have produced a topic: the named ones, the default one, other built-in ones."""
    yield from (spec for spec in specs if not spec.ros_types or definition.root in spec.ros_types)
    yield ROSBridge().resolve(info.name, definition.root).spec
    yield from (spec for spec in BUILTIN if definition.root in spec.ros_types)
    yield UnmodeledSpec(serialization_format=info.ontology.serialization_format)


def _produces(adapter: Adapter, info: TopicInfo) -> bool:
    ontology = adapter.ontology
    return (ontology.tag, ontology.struct) == (info.ontology.tag, info.ontology.struct)


def export_sequence(
    store: Store,
    sequence: str,
    path: Path | str,
    *,
    topics: Sequence[str] = (),
    start_ns: int | None = None,
    end_ns: int | None = None,
    adapters: Sequence[str] = (),
    replace: bool = False,
) -> ExportReport:
    """Write a sequence, or the selected topics and time range of it, to a recording.

    The suffix of the file selects the container: `.mcap`, `.db3` (ROS 2) or `.bag` (ROS 1). `start_ns` is inclusive, `end_ns`
    exclusive.

    Raises:
        NothingMatched: No topic or message is selected, or no topic can be exported.
        BagError: The file already exists, or it cannot be written.
        SinkError: The sequence does not exist or cannot be read.
        AdapterError: One of `adapters` cannot be loaded.
    """
    path = Path(path)
    selected = _selected(store.sequence(sequence), topics)
    specs = [adapter_spec(reference, Path()) for reference in adapters]
    with open_writer(path, replace=replace) as writer:
        restorers: list[tuple[int, Restorer]] = []
        excluded: list[TopicExport] = []
        for info in selected:
            outcome = _prepare(info, selected, specs, path.suffix, writer)
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
        messages = [
            _messages(store, connection, restorer, start_ns, end_ns) for connection, restorer in restorers
        ]
        for log_ns, connection, payload in heapq.merge(*messages, key=lambda message: message[0]):
            writer.write(connection, log_ns, payload)
        if not any(restorer.messages for _, restorer in restorers):
            raise NothingMatched(
                "no message is in the selected time range", where=sequence, hint="check --start and --end"
            )
    results = [*(restorer.result() for _, restorer in restorers), *excluded]
    results.sort(key=lambda result: result.topic)
    return ExportReport(sequence=sequence, path=str(path), bytes=path.stat().st_size, topics=tuple(results))


def _selected(sequence: SequenceInfo, patterns: Sequence[str]) -> tuple[TopicInfo, ...]:
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


def _prepare(
    info: TopicInfo,
    selected: Sequence[TopicInfo],
    specs: Sequence[AdapterSpec],
    suffix: str,
    writer: RecordingWriter,
) -> tuple[int, Restorer] | TopicExport:
    """Add the connection of a topic, or return the reason why the topic cannot be exported."""
    origin = origin_of(info)
    if origin is None:
        return _excluded(info, "", "its metadata does not describe the original messages")
    others = [other for topic in selected if (other := origin_of(topic)) is not None]
    version = version_of(origin, others, ROS_VERSIONS[suffix])
    try:
        restorer = restorer_for(info, origin.definition(version), specs)
        return writer.add_connection(info.name, restorer.definition), restorer
    except (AdapterError, BagError) as error:
        return _excluded(info, origin.msgtype, f"{error.what} — {error.hint}" if error.hint else error.what)


def _excluded(info: TopicInfo, msgtype: str, reason: str) -> TopicExport:
    return TopicExport(topic=info.name, msgtype=msgtype, ontology=info.ontology.tag, excluded=reason)


def _first_reason(excluded: Sequence[TopicExport]) -> str:
    return f"{excluded[0].topic}: {excluded[0].excluded}"


def _messages(
    store: Store, connection: int, restorer: Restorer, start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[int, int, bytes]]:
    info = restorer.info
    with store.scan(info.sequence, info.name, start_ns=start_ns, end_ns=end_ns) as reader:
        for log_ns, payload in restorer.read(iter(reader)):
            yield log_ns, connection, payload
