"""The plan of one recording: every decision that a run follows, and its serialized form."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from os.path import relpath
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, JsonValue, PlainSerializer, SerializationInfo
from typing_extensions import TypedDict

from mosaico_ingest.adapters.adapter import RESERVED_KEYS, AdapterSpec, EncodedImageSpec
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.contracts import Contract, ReadTopic
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.display import count_text, counted
from mosaico_ingest.documents import Part, Unchecked, html_table
from mosaico_ingest.findings import Finding, Span, escape_undecodable
from mosaico_ingest.job.model import ErrorPolicy, Manifest, QuarantineSettings, SequenceSettings
from mosaico_ingest.job.split import SequencePart
from mosaico_ingest.job.values import StampSource, Target, TopicLevelErrorPolicy
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.pipeline.task import Attempt, MemoryBudget
from mosaico_ingest.remote import RemotePath
from mosaico_ingest.rosbag.blocks import Attachment
from mosaico_ingest.rosbag.definitions.model import Resolver


class AdapterDocument(TypedDict):
    """An adapter in a plan document."""

    name: str
    digest: str | None
    """Digest of the content of an adapter file; comments and layout do not count."""


class OntologyDocument(TypedDict):
    """An ontology type in a plan document."""

    tag: str
    fingerprint: str
    """Identifies the columns of the type."""
    serialization_format: str


class FileDocument(TypedDict):
    """A file of the recording in a plan document."""

    path: str
    """Relative to the manifest's folder."""
    size_bytes: int


class AttachmentDocument(TypedDict):
    """An attachment in a plan document."""

    name: str
    media_type: str
    size_bytes: int


class PartDocument(TypedDict):
    """A part of a recording in a plan document."""

    recording: str
    """The name of the sequence that the complete recording would become."""
    number: int
    event: str | None


class PolicyDocument(TypedDict):
    """The error policies in a plan document that apply to the entire recording."""

    session: str
    message: str


def _describe_policy(policy: ErrorPolicy) -> PolicyDocument:
    return {"session": policy.session.value, "message": policy.message.value}


def _describe_adapter(spec: AdapterSpec) -> AdapterDocument:
    inner = spec.inner if isinstance(spec, EncodedImageSpec) else spec
    digest = None
    if isinstance(inner, MappingSpec):
        digest = hashlib.sha256(inner.model.model_dump_json().encode()).hexdigest()[:16]
    name = f"{spec.name}, then {spec.settings.format}" if isinstance(spec, EncodedImageSpec) else spec.name
    return {"name": name, "digest": digest}


def _describe_ontology(ontology: OntologyType) -> OntologyDocument:
    return {
        "tag": ontology.tag,
        "fingerprint": ontology.fingerprint,
        "serialization_format": ontology.serialization_format.value,
    }


def _own_metadata(metadata: Mapping[str, Any]) -> dict[str, JsonValue]:
    return {key: value for key, value in metadata.items() if key not in RESERVED_KEYS}


def _describe_files(files: tuple[Path | RemotePath, ...], info: SerializationInfo) -> list[FileDocument]:
    return [{"path": _relative(path, info), "size_bytes": path.stat().st_size} for path in files]


def _describe_attachments(attachments: tuple[Attachment, ...]) -> list[AttachmentDocument]:
    return [
        {"name": each.name, "media_type": each.media_type, "size_bytes": each.size_bytes}
        for each in attachments
    ]


def _describe_part(part: SequencePart | None) -> PartDocument | None:
    if part is None:
        return None
    return {"recording": part.recording, "number": part.number, "event": part.event}


def _describe_contract(contract: Contract | None) -> dict[str, JsonValue] | None:
    if contract is None:
        return None
    # The serializer of manifests contains that of the section, which would take another 5 ms to build.
    manifest = Manifest.model_construct(expect=contract.expect)
    return manifest.model_dump(mode="json", include={"expect"}, exclude_defaults=True)["expect"]


def _describe_quarantine(
    quarantine: QuarantineSettings | None, info: SerializationInfo
) -> dict[str, JsonValue] | None:
    if quarantine is None:
        return None
    return quarantine.replace(path=_relative(Path(quarantine.path), info)).model_dump(mode="json")


def _describe_destination(target: Target, info: SerializationInfo) -> str:
    return destination_of(target).describe(folder=_folder(info))


def _relative(path: Path | RemotePath, info: SerializationInfo) -> str:
    text = str(path) if isinstance(path, RemotePath) else Path(relpath(path, _folder(info))).as_posix()
    return escape_undecodable(text)


def _folder(info: SerializationInfo) -> Path:
    return (info.context or {}).get("folder", Path())


class TopicPlan(Part):
    """A topic that is read: its connections, its adapter and its name in the sequence."""

    topic: str
    """The name in the recording."""
    target: str
    """The name in the sequence."""
    msgtype: str
    connections: tuple[int, ...] = Field(exclude=True)
    """The ids of the connections."""
    definitions: tuple[str, ...] = ()
    """The source of each definition and the digest of its text, such as `bag 1f0c9a22b7e4d8a3`."""
    adapter: Annotated[AdapterSpec, Unchecked(), PlainSerializer(_describe_adapter)]
    why: str
    """The rule that selected the adapter."""
    ontology: Annotated[OntologyType, Unchecked(), PlainSerializer(_describe_ontology)]
    """The ontology type of the rows."""
    count: int | None
    """The number of messages in the recording's index."""
    every: int = 1
    """Keep the first of each `every` messages."""
    where: str | None = None
    """Keep messages for which this expression is true."""
    on_change: tuple[str, ...] = ()
    """Keep messages for which one of these expressions differs from the previous message."""
    rate: float | None = None
    """Keep the first message of each interval of this frequency, in Hz."""
    stamp: StampSource = StampSource.LOG
    """The time that becomes `timestamp_ns`."""
    time_offset_ns: int = 0
    """The duration that is added to every time."""
    latched: bool = False
    """True if messages before the time range are included, see `bag.time.latched`."""
    on_error: TopicLevelErrorPolicy
    metadata: Annotated[Mapping[str, Any], Unchecked(), PlainSerializer(_own_metadata)]
    shares_messages: bool = False
    """True if another topic counts the same messages, because the adapter has several outputs."""

    @property
    def output(self) -> str:
        """The name of the output of its adapter that the topic is; empty for an adapter without `outputs`."""
        return self.adapter.output if isinstance(self.adapter, MappingSpec) else ""

    @property
    def has_conditions(self) -> bool:
        """Whether `where` or `on_change` selects messages."""
        return self.where is not None or bool(self.on_change)

    @property
    def has_log_times(self) -> bool:
        """Whether the times of the rows are the log times."""
        return self.stamp is StampSource.LOG and self.time_offset_ns == 0


def observed_topics(topics: Sequence[TopicPlan]) -> list[ReadTopic]:
    """Return the topics as a data contract observes them: with all outputs of adapters that have `outputs`."""
    outputs: dict[int, list[tuple[str, OntologyType]]] = {}
    for topic in topics:
        if topic.output:
            outputs.setdefault(topic.connections[0], []).append((topic.target, topic.ontology))
    return [
        ReadTopic(
            topic.topic,
            topic.connections,
            None if topic.output else topic.ontology,
            tuple(outputs[topic.connections[0]]) if topic.output else (),
        )
        for topic in topics
        if not topic.shares_messages
    ]


class ExcludedTopic(Part):
    """A topic that is not read."""

    topic: str
    msgtype: str
    count: int | None
    why: str
    """The reason."""
    span: Annotated[Span | None, Unchecked()] = Field(default=None, exclude=True)
    """The location in the manifest that excludes the topic."""
    undefined: bool = Field(default=False, exclude=True)
    """True if the topic is selected but no definition of its type is known: its messages count as unreadable."""


class Plan(Part):
    """Every decision about one recording; `document` returns what `ingest plan` writes and compares."""

    sequence: SequenceSettings
    files: Annotated[tuple[Path | RemotePath, ...], Unchecked(), PlainSerializer(_describe_files)]
    container: str
    """The file format, detected from the first bytes."""
    start_ns: int | None = None
    """The log time of the first message, ns since the epoch."""
    end_ns: int | None = None
    """The log time of the last message, ns since the epoch."""
    read_from_ns: int | None = None
    """Earlier messages are not read; ns since the epoch."""
    read_until_ns: int | None = None
    """Messages of this log time or later are not read; ns since the epoch."""
    part: Annotated[SequencePart | None, Unchecked(), PlainSerializer(_describe_part)] = None
    """The part of the recording that becomes the sequence, if `split` divides the recording."""
    destination: Annotated[Target, Unchecked(), PlainSerializer(_describe_destination)]
    """The location of the store or server; a path is relative to the manifest's folder."""
    on_error: Annotated[ErrorPolicy, PlainSerializer(_describe_policy)]
    """The policies for the session and for messages that cannot be decoded; each topic has its own policy."""
    quarantine: Annotated[QuarantineSettings | None, PlainSerializer(_describe_quarantine)] = None
    """Where rejected messages are kept; the path is relative to the manifest's folder."""
    attachments: Annotated[tuple[Attachment, ...], Unchecked(), PlainSerializer(_describe_attachments)] = ()
    """The attachments that become files of the sequence."""
    topics: tuple[TopicPlan, ...]
    excluded: tuple[ExcludedTopic, ...] = ()
    contract: Annotated[Contract | None, Unchecked(), PlainSerializer(_describe_contract)] = None
    """The data contract: the keys of `expect` that differ from their defaults."""

    kept_metadata: Annotated[Mapping[str, Any], Unchecked()] = Field(default={}, exclude=True)
    """Metadata of the recording that the sequence keeps under reserved keys."""
    memory: Annotated[MemoryBudget, Unchecked()] = Field(default=MemoryBudget(), exclude=True)
    source_bytes: int = Field(exclude=True)
    resolver: Annotated[Resolver, Unchecked()] = Field(exclude=True)
    findings: Annotated[tuple[Finding, ...], Unchecked()] = Field(default=(), exclude=True)
    missing: Annotated[tuple[Path | RemotePath, ...], Unchecked()] = Field(default=(), exclude=True)
    """Splits that the recording's metadata lists and that do not exist."""
    attempt: Annotated[Attempt | None, Unchecked()] = Field(default=None, exclude=True)
    """The attempt of an executor that may start a recording more than once."""

    @property
    def read_topics(self) -> tuple[TopicPlan, ...]:
        """The topics, except topics that share their messages with another topic."""
        return tuple(topic for topic in self.topics if not topic.shares_messages)

    @property
    def selects_after_reading(self) -> bool:
        """Whether the time range is applied to the rows, because the times of some rows are not the log times."""
        bounded = self.read_from_ns is not None or self.read_until_ns is not None
        return bounded and not all(topic.has_log_times for topic in self.topics)

    @property
    def log_range(self) -> tuple[int | None, int | None]:
        """The range of log times to read: the start (inclusive) and the end (exclusive), ns since the epoch."""
        if not self.selects_after_reading:
            return self.read_from_ns, self.read_until_ns
        return (None, None) if self.part is None else (self.part.read_from_ns, self.part.read_until_ns)

    def __repr__(self) -> str:
        """Return the counts of the plan, such as `<Plan yard: 9 topics, 2,110 messages, 31 excluded>`."""
        return f"<Plan {plan_headline(self.sequence.name, [topic.count for topic in self.read_topics], len(self.excluded))}>"

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        rows = (
            (
                topic.topic,
                topic.msgtype,
                "?" if topic.count is None else count_text(topic.count),
                topic.ontology.tag,
                topic.why,
            )
            for topic in self.topics
        )
        names = ("topic", "type", "messages", "becomes", "because")
        notes = [str(finding) for finding in self.findings]
        return html_table(
            repr(self)[1:-1], names, rows, count=len(self.topics), numbers={"messages"}, notes=notes
        )

    def document(self, *, folder: Path) -> dict[str, Any]:
        """Return the decisions as JSON; paths are relative to `folder`."""
        return self.model_dump(mode="json", context={"folder": folder})


def plan_headline(sequence: str, counts: Sequence[int | None], excluded: int) -> str:
    """Return the number of selected topics, of their messages, and of excluded topics."""
    messages = "? messages" if None in counts else counted(sum(count or 0 for count in counts), "message")
    more = f", {count_text(excluded)} excluded" if excluded else ""
    return f"{sequence}: {counted(len(counts), 'topic')}, {messages}{more}"


def digest_of(document: Mapping[str, Any]) -> str:
    """Return the digest that identifies the decisions of a plan document."""
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()[:16]
