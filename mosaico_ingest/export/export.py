"""Export a sequence as a recording: restore the messages of each topic and write them by time."""

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
from mosaico_ingest.rosbag.serialization import Serializer
from mosaico_ingest.rosbag.writers import ROS_VERSIONS, RecordingWriter, open_writer

__all__ = [
    "ExportReport",
    "Message",
    "Origin",
    "Restorer",
    "TopicExport",
    "export_sequence",
    "origin_of",
    "restorer_for",
    "version_of",
]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class TopicExport(_Record):
    """What became of one topic."""

    topic: str
    msgtype: str = ""
    """`pkg/msg/Name`; empty where the topic does not say."""
    ontology: str
    adapter: str = ""
    """The adapter that was undone; `Unmodeled`: the messages kept their shape."""
    messages: int = 0
    unknown: tuple[str, ...] = ()
    """Fields that are not in the store; they are zero, empty or false in every message."""
    not_undone: dict[str, str] = {}
    """Columns that no field could be computed from, and what they were computed as."""
    changed: dict[str, int] = {}
    """Columns that would come out otherwise if the file were ingested, and in how many rows."""
    excluded: str = ""
    """Why it is not in the file; empty where it is."""

    @property
    def faithful(self) -> bool:
        """Whether the file, ingested in the same way, gives the same rows."""
        return not self.excluded and not self.changed


class ExportReport(_Record):
    """What one export did."""

    sequence: str
    path: str
    bytes: int
    topics: tuple[TopicExport, ...]

    @property
    def messages(self) -> int:
        """How many messages the file holds."""
        return sum(topic.messages for topic in self.topics)

    @property
    def faithful(self) -> bool:
        """Whether every topic is in the file, and gives the same rows again."""
        return all(topic.faithful for topic in self.topics)


_TIME_1 = re.compile(r"^(?:time|duration)(?:\[\d*\])?\s", re.MULTILINE)
_TIME_2 = re.compile(r"^builtin_interfaces/(?:Time|Duration)(?:\[[<=\d]*\])?\s", re.MULTILINE)


class Origin(Struct, frozen=True):
    """The messages a topic was made of."""

    msgtype: str
    text: str
    """The flattened definition."""
    source_file: str

    @property
    def version(self) -> int | None:
        """The version of ROS its definition can only be of; None where it has no time in it."""
        return 1 if _TIME_1.search(self.text) else 2 if _TIME_2.search(self.text) else None

    def definition(self, version: int) -> Definition:
        """Return the definition, as of a version of ROS.

        Raises:
            BagError: The text cannot be read.
        """
        embedded = Embedded(f"ros{version}msg", self.text)
        return TypeResolver(Stores.EMPTY).resolve(self.msgtype, embedded, ros_version=version)


def origin_of(topic: TopicInfo) -> Origin | None:
    """Return what a topic was made of; None where it does not say."""
    said = topic.metadata.get(ROS_METADATA_KEY)
    if not isinstance(said, dict):
        return None
    values = cast("Mapping[str, Any]", said)
    found = [values.get(key, "") for key in ("msgtype", "msgdef", "source_file")]
    if not all(isinstance(value, str) for value in found) or not found[0]:
        return None
    return Origin(*found)


def version_of(origin: Origin, others: Sequence[Origin], possible: Collection[int]) -> int:
    """Return the version of ROS of a topic: its definition's, else that of the topics it was recorded with."""
    known = [one.version for one in (origin, *others) if one.source_file == origin.source_file]
    said = next((version for version in known if version is not None), None)
    if said is None:
        said = 1 if PurePath(origin.source_file).suffix == ".bag" else 2
    return said if said in possible or origin.version is not None else min(possible)


_ROWS = 1000
"""Messages made at a time."""

Message = tuple[int, bytes]
"""Log time in ns, and payload."""


@dataclass(slots=True)
class Restorer:
    """Makes the messages of one topic, and counts what they lack."""

    info: TopicInfo
    definition: Definition
    adapter: str
    inverse: Inverse
    messages: int = 0
    _unknown: dict[str, None] = field(default_factory=dict[str, None])
    _kept_out: dict[str, str] = field(default_factory=dict[str, str])
    _changed: Counter[str] = field(default_factory=Counter[str])

    def read(self, batches: Iterator[pa.RecordBatch]) -> Iterator[Message]:
        """Yield the topic's messages in the order of the rows.

        Raises:
            BagError: A value has no place in the message.
        """
        encoding = Encoding.ROS1 if self.definition.ros_version == 1 else Encoding.CDR
        serializer = Serializer(self.definition, encoding)
        for batch in batches:
            for start in range(0, batch.num_rows, _ROWS):
                part = batch.slice(start, _ROWS)
                times: Any = part.column(0).to_numpy()
                rows = struct_of(part.columns[1:], self.info.ontology.struct, None, part.num_rows)
                envelope = Envelope(self.info.name, self.definition.root, times)
                restored = self.inverse.restore(rows, envelope)
                self._count(restored)
                values: Any = cast("Any", restored.rows).to_pylist()  # the stubs do not know a struct's
                yield from zip(times.tolist(), map(serializer.from_dict, values), strict=True)

    def account(self) -> TopicExport:
        """Return what became of the topic so far."""
        return TopicExport(
            topic=self.info.name,
            msgtype=self.definition.root,
            ontology=self.info.ontology.tag,
            adapter=self.adapter,
            messages=self.messages,
            unknown=tuple(self._unknown),
            not_undone=dict(self._kept_out),
            changed=dict(self._changed),
        )

    def _count(self, restored: Restored) -> None:
        self.messages += len(restored.rows)
        self._unknown.update(dict.fromkeys(restored.defaulted))
        self._kept_out.update(restored.not_invertible or {})
        self._changed.update(restored.changed or {})


def restorer_for(info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]) -> Restorer:
    """Return the way back for a topic, through the first adapter that makes columns like its own.

    Raises:
        AdapterError: None does, or it has no way back.
    """
    shape = ros_shape(definition)
    misfits: list[str] = []
    for spec in _candidates(info, definition, specs):
        try:
            adapter = spec.bind(definition, shape)
        except AdapterError as error:
            misfits.append(error.what)
            continue
        if _makes(adapter, info):
            inverse = invert(adapter, shape, info.metadata)
            return Restorer(info, definition, spec.name, inverse)
    raise AdapterError(
        f"no adapter known makes {info.ontology.tag} of {definition.root}",
        hint=misfits[0] if misfits else "name the one that did with --adapter",
    )


def _candidates(
    info: TopicInfo, definition: Definition, specs: Sequence[AdapterSpec]
) -> Iterator[AdapterSpec]:
    """Yield the adapters that may have made a topic: those named, the default one, the others of the catalog."""
    yield from (spec for spec in specs if not spec.ros_types or definition.root in spec.ros_types)
    yield ROSBridge().resolve(info.name, definition.root).spec
    yield from (spec for spec in BUILTIN if definition.root in spec.ros_types)
    yield UnmodeledSpec(serialization_format=info.ontology.serialization_format)


def _makes(adapter: Adapter, info: TopicInfo) -> bool:
    made = adapter.ontology
    return (made.tag, made.struct) == (info.ontology.tag, info.ontology.struct)


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
    """Write a sequence, or what patterns and a span of time select of it, to a recording; return the account.

    The file's suffix says which kind: `.mcap`, `.db3` (ROS 2) or `.bag` (ROS 1). `start_ns` is in, `end_ns` is not.

    Raises:
        NothingMatched: No topic is selected, or none can be written.
        BagError: The file is there already, or cannot be written.
        SinkError: There is no such sequence, or it cannot be read.
        AdapterError: One of `adapters` is none.
    """
    path = Path(path)
    found = store.sequence(sequence)
    chosen = _selected(found, topics)
    specs = [adapter_spec(reference, Path()) for reference in adapters]
    with open_writer(path, replace=replace) as writer:
        restorers: list[tuple[int, Restorer]] = []
        left: list[TopicExport] = []
        for info in chosen:
            outcome = _prepare(info, chosen, specs, path.suffix, writer)
            if isinstance(outcome, TopicExport):
                left.append(outcome)
            else:
                restorers.append(outcome)
        if not restorers:
            raise NothingMatched(
                f"none of {len(left)} topics can be written", where=sequence, hint=_first(left)
            )
        streams = [
            _stream(store, connection, restorer, start_ns, end_ns) for connection, restorer in restorers
        ]
        for log_ns, connection, payload in heapq.merge(*streams, key=lambda message: message[0]):
            writer.write(connection, log_ns, payload)
        if not any(restorer.messages for _, restorer in restorers):
            raise NothingMatched(
                "there is no message to write", where=sequence, hint="look at --start and --end"
            )
    accounts = [*(restorer.account() for _, restorer in restorers), *left]
    accounts.sort(key=lambda one: one.topic)
    return ExportReport(sequence=sequence, path=str(path), bytes=path.stat().st_size, topics=tuple(accounts))


def _selected(found: SequenceInfo, patterns: Sequence[str]) -> tuple[TopicInfo, ...]:
    names = [topic.name for topic in found.topics]
    selection = select(patterns, names)
    if not selection.selected:
        what = f"no topic matches {', '.join(map(repr, patterns))}" if names else "the sequence has no topic"
        raise NothingMatched(what, where=found.name, hint=suggest_names(names, patterns) if names else None)
    return tuple(topic for topic in found.topics if topic.name in selection.selected)


def _prepare(
    info: TopicInfo,
    chosen: Sequence[TopicInfo],
    specs: Sequence[AdapterSpec],
    suffix: str,
    writer: RecordingWriter,
) -> tuple[int, Restorer] | TopicExport:
    """Open the connection of a topic, or say why it cannot be."""
    origin = origin_of(info)
    if origin is None:
        return _left(info, "", "its metadata does not say which messages it was made of")
    others = [other for topic in chosen if (other := origin_of(topic)) is not None]
    version = version_of(origin, others, ROS_VERSIONS[suffix])
    try:
        restorer = restorer_for(info, origin.definition(version), specs)
        return writer.add_connection(info.name, restorer.definition), restorer
    except (AdapterError, BagError) as error:
        return _left(info, origin.msgtype, f"{error.what} — {error.hint}" if error.hint else error.what)


def _left(info: TopicInfo, msgtype: str, why: str) -> TopicExport:
    return TopicExport(topic=info.name, msgtype=msgtype, ontology=info.ontology.tag, excluded=why)


def _first(left: Sequence[TopicExport]) -> str:
    return f"{left[0].topic}: {left[0].excluded}"


def _stream(
    store: Store, connection: int, restorer: Restorer, start_ns: int | None, end_ns: int | None
) -> Iterator[tuple[int, int, bytes]]:
    info = restorer.info
    with store.scan(info.sequence, info.name, start_ns=start_ns, end_ns=end_ns) as reader:
        for log_ns, payload in restorer.read(iter(reader)):
            yield log_ns, connection, payload
