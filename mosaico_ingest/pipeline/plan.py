"""The plan: every decision about one recording, its file format, and the comparison of two plans."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os.path import relpath
from pathlib import Path
from typing import Any, Literal, TypeAlias

from msgspec import Struct
from pydantic import Field, JsonValue

from mosaico_ingest.adapters.adapter import ROS_METADATA_KEY, AdapterSpec
from mosaico_ingest.adapters.image import PngImageSpec
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.documents import Part, document_schema, read_document
from mosaico_ingest.errors import IngestError, ManifestError
from mosaico_ingest.findings import Finding, Severity, Span, Stage
from mosaico_ingest.job.config import Attempt, QuarantineSettings, ROSInjectionConfig
from mosaico_ingest.job.values import (
    IfExists,
    Limit,
    LoaderErrorPolicy,
    SessionLevelErrorPolicy,
    Target,
    TopicLevelErrorPolicy,
)
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.pipeline.memory import MemoryBudget
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.definitions.model import Resolver
from mosaico_ingest.textfile import read_limited

__all__ = [
    "Decisions",
    "DestinationState",
    "Difference",
    "ExcludedTopic",
    "ExcludedTopicDocument",
    "FilePart",
    "Kept",
    "Note",
    "Plan",
    "PlanDocument",
    "PlannedTopic",
    "RecordingPlan",
    "Sample",
    "SampleRejection",
    "TopicPlan",
    "check_digest",
    "decisions",
    "differences",
    "notes",
    "plan_schema",
    "read_plan",
]


class TopicPlan(Struct, frozen=True):
    """One stream: the connections it is made of, what it becomes, and why."""

    topic: str
    """Its name in the recording."""
    target: str
    """Its name in the sequence."""
    msgtype: str
    connections: tuple[int, ...]
    adapter: AdapterSpec
    why: str
    """Which rule chose the adapter."""
    ontology: OntologyType
    count: int | None
    """How many messages the index promises."""
    metadata: Mapping[str, Any]
    on_error: TopicLevelErrorPolicy
    every: int = 1
    """Keep the first of each `every` messages."""
    definitions: tuple[str, ...] = ()
    """Where each of its definitions was found, and the digest of its text, as `bag 1f0c9a22b7e4d8a3`."""


class ExcludedTopic(Struct, frozen=True):
    """A topic of the recording that will not be read, and why."""

    topic: str
    msgtype: str
    count: int | None
    why: str
    span: Span | None = None
    """The location in the manifest that excludes the topic."""
    undefined: bool = False
    """True if the topic is selected but no definition of its type is known: its messages count as unreadable."""


class Plan(Struct, frozen=True):
    """What will be done with one recording."""

    files: tuple[AnyPath, ...]
    container: str
    source_bytes: int
    resolver: Resolver
    sequence: str
    metadata: Mapping[str, Any]
    target: Target
    if_exists: IfExists
    on_error: SessionLevelErrorPolicy
    on_message_error: LoaderErrorPolicy
    topics: tuple[TopicPlan, ...]
    excluded: tuple[ExcludedTopic, ...] = ()
    findings: tuple[Finding, ...] = ()
    start_ns: int | None = None
    """The first instant of the recording, ns since the epoch."""
    end_ns: int | None = None
    read_from_ns: int | None = None
    """Messages recorded before are not read."""
    read_until_ns: int | None = None
    """Messages recorded at this instant or later are not read."""
    quarantine: QuarantineSettings | None = None
    """Where rejected messages are kept."""
    missing: tuple[AnyPath, ...] = ()
    """Parts of the recording that are not there, though its metadata list them."""
    family: str | None = None
    """What the sequences of the same job, for other recordings, have in common."""
    memory: MemoryBudget = MemoryBudget()
    """The memory for messages and rows, from reading to writing."""
    attempt: Attempt | None = None
    """Which try this is, where there may be several."""


class FilePart(Part):
    """One file of the recording."""

    path: str
    """Seen from the manifest's folder."""
    size_bytes: int


class PlannedTopic(Part):
    """A topic that will be read, and what it becomes."""

    topic: str
    """Its name in the recording."""
    target: str
    """Its name in the sequence."""
    msgtype: str
    definitions: tuple[str, ...]
    """Where its definitions are found (bag, custom, distro), each with the digest of its text."""
    adapter: str
    adapter_digest: str | None
    """Digest of the adapter's file, for adapters that are files."""
    why: str
    """Which rule chose the adapter."""
    ontology: str
    """The ontology tag its rows have."""
    fingerprint: str
    """The name of the columns its rows have."""
    serialization_format: str
    count: int | None
    """How many messages the recording's index promises."""
    every: int
    """One message in so many is kept."""
    on_error: TopicLevelErrorPolicy
    metadata: dict[str, JsonValue]


class ExcludedTopicDocument(Part):
    """A topic that will not be read."""

    topic: str
    msgtype: str
    count: int | None
    why: str


class Kept(Part):
    """Where rejected messages are kept, and how many; limits are a number of messages or, below 1, a share of them."""

    path: str
    """Seen from the manifest's folder."""
    max: int | float | None
    """Of one topic."""
    max_run: int | float | None
    """Of all topics together."""
    systematic: int
    """So many failures from the very start of a topic end it."""


class Decisions(Part):
    """Everything that a run follows, and that `--check` compares."""

    sequence: str
    metadata: dict[str, JsonValue]
    files: tuple[FilePart, ...]
    container: str
    """The files' format, told by their first bytes."""
    start_ns: int | None
    """The first instant of the recording, ns since the epoch."""
    end_ns: int | None
    """The last one, inclusive."""
    read_from_ns: int | None
    """Messages recorded before are not read."""
    read_until_ns: int | None
    """Messages recorded at this instant or later are not read."""
    destination: str
    """A store's folder seen from the manifest's, or a server's host and port."""
    if_exists: IfExists
    on_error: SessionLevelErrorPolicy
    on_message_error: LoaderErrorPolicy
    quarantine: Kept | None = None
    topics: tuple[PlannedTopic, ...]
    excluded: tuple[ExcludedTopicDocument, ...]

    @property
    def digest(self) -> str:
        """A short name for exactly these decisions."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


class Note(Part):
    """Something to know, with the place of its cause."""

    severity: Severity
    rule: str
    message: str
    place: str | None
    """As `job.yaml:3:5`."""
    help: str | None


class SampleRejection(Part):
    """Messages of the sample that would be rejected for the same reason."""

    stage: Stage
    rule: str
    count: int
    reason: str


class Sample(Part):
    """What became of a topic's first messages, decoded and adapted on trial."""

    target: str
    read: int
    rejected: int
    row_bytes: int | None
    """How much a row takes, uncompressed."""
    rejections: tuple[SampleRejection, ...]


class DestinationState(Part):
    """What the destination said; null where it was not asked."""

    kind: str
    """`store`, `server`, or the type of an installed destination."""
    exists: bool | None
    """Whether there is a store, or a server that answers."""
    taken: bool | None
    """Whether it has a sequence of that name."""
    problem: str | None
    """Why it will not take the sequence."""
    free_bytes: int | None
    estimated_bytes: int | None
    """What the rows take uncompressed, judged by the sample; what is stored is mostly less."""


class RecordingPlan(Part):
    """One recording: what was decided, and what was seen."""

    digest: str
    """Names the decisions; `ingest run --plan` runs nothing else."""
    decisions: Decisions
    destination: DestinationState
    samples: tuple[Sample, ...]
    notes: tuple[Note, ...]

    @property
    def rejected(self) -> int:
        """How many messages of the samples would be rejected."""
        return sum(sample.rejected for sample in self.samples)

    @property
    def is_empty(self) -> bool:
        """Whether the index promises no message of any topic taken."""
        return all(topic.count == 0 for topic in self.decisions.topics)


class PlanDocument(Part):
    """What one manifest would do; `version` changes when the form does."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote this."""
    job: str = Field(examples=["job.yaml"])
    """The manifest, seen from this file's folder."""
    recordings: tuple[RecordingPlan, ...]

    @property
    def exit_code(self) -> int:
        """1 where a destination refuses, 3 where there is no message, 4 where some of a sample would be rejected, else 0."""
        if any(recording.destination.problem for recording in self.recordings):
            return 1
        if any(recording.is_empty for recording in self.recordings):
            return 3
        return 4 if any(recording.rejected for recording in self.recordings) else 0


def read_plan(path: Path) -> PlanDocument:
    """Read a plan file.

    Raises:
        ManifestError: The file cannot be read or violates the schema of plans.
    """
    hint = "make one with `ingest plan job.yaml --out plan.json`"
    try:
        content = read_limited(path)
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path), hint=hint) from error
    return read_document(content, PlanDocument, where=str(path), kind="a plan", hint=hint)


def decisions(plan: Plan, *, folder: Path) -> Decisions:
    """Return what a run of the plan follows; paths are seen from `folder`."""
    return Decisions(
        sequence=plan.sequence,
        metadata=dict(plan.metadata),
        files=tuple(
            FilePart(path=_seen_from(folder, path), size_bytes=path.stat().st_size) for path in plan.files
        ),
        container=plan.container,
        start_ns=plan.start_ns,
        end_ns=plan.end_ns,
        read_from_ns=plan.read_from_ns,
        read_until_ns=plan.read_until_ns,
        destination=destination_of(plan.target).describe(folder=folder),
        if_exists=plan.if_exists,
        on_error=plan.on_error,
        on_message_error=plan.on_message_error,
        quarantine=None if plan.quarantine is None else _kept(plan.quarantine, folder),
        topics=tuple(map(_planned, plan.topics)),
        excluded=tuple(map(_unread, plan.excluded)),
    )


def check_digest(plan: Plan, config: ROSInjectionConfig) -> None:
    """Refuse a plan that is not the one the configuration is for.

    Raises:
        IngestError: It is another one.
    """
    wanted = config.plan_digest
    if wanted is not None and decisions(plan, folder=config.base_dir).digest != wanted:
        raise IngestError(
            "the recording no longer fits the plan",
            where=str(plan.files[0]),
            hint="`ingest plan --check` says how; make a new plan",
        )


def notes(findings: Iterable[Finding]) -> tuple[Note, ...]:
    """Return findings as a document holds them."""
    return tuple(
        Note(
            severity=finding.severity,
            rule=finding.rule,
            message=finding.message,
            place=str(finding.span) if finding.span else None,
            help=finding.help,
        )
        for finding in findings
    )


def _kept(settings: QuarantineSettings, folder: Path) -> Kept:
    def bound(limit: Limit | None) -> int | float | None:
        return None if limit is None else limit.count if limit.share is None else limit.share

    return Kept(
        path=_seen_from(folder, settings.path),
        max=bound(settings.max),
        max_run=bound(settings.max_run),
        systematic=settings.systematic,
    )


def _planned(topic: TopicPlan) -> PlannedTopic:
    return PlannedTopic(
        topic=topic.topic,
        target=topic.target,
        msgtype=topic.msgtype,
        definitions=topic.definitions,
        adapter=_name(topic.adapter),
        adapter_digest=_digest(topic.adapter),
        why=topic.why,
        ontology=topic.ontology.tag,
        fingerprint=topic.ontology.fingerprint,
        serialization_format=topic.ontology.serialization_format.value,
        count=topic.count,
        every=topic.every,
        on_error=topic.on_error,
        metadata={key: value for key, value in topic.metadata.items() if key != ROS_METADATA_KEY},
    )


def _name(spec: AdapterSpec) -> str:
    return f"{spec.name}, then PNG" if isinstance(spec, PngImageSpec) else spec.name


def _unread(topic: ExcludedTopic) -> ExcludedTopicDocument:
    return ExcludedTopicDocument(topic=topic.topic, msgtype=topic.msgtype, count=topic.count, why=topic.why)


def _digest(spec: AdapterSpec) -> str | None:
    """Return the digest of what an adapter file says, comments and layout aside."""
    if isinstance(spec, PngImageSpec):
        return _digest(spec.inner)
    if not isinstance(spec, MappingSpec):
        return None
    return hashlib.sha256(spec.model.model_dump_json().encode()).hexdigest()[:16]


def _seen_from(folder: Path, path: AnyPath) -> str:
    if isinstance(path, RemotePath):
        return str(path)
    return Path(relpath(path, folder)).as_posix()


Json: TypeAlias = Any

_NAMES = {"topics": ("topic", "target"), "excluded": ("excluded topic", "topic"), "files": ("file", "path")}
"""How an item of a list is called, and the key that tells it from the others."""


class Difference(Struct, frozen=True):
    """One thing that is not the same; what is not there on one side is None."""

    sequence: str
    what: str
    before: str | None
    after: str | None

    def __str__(self) -> str:
        """Return the difference in one line."""
        if self.before is None:
            return f"{self.sequence}: + {self.what}: {self.after}"
        if self.after is None:
            return f"{self.sequence}: - {self.what}: {self.before}"
        return f"{self.sequence}: {self.what}: {self.before} → {self.after}"


def differences(before: Sequence[Decisions], after: Sequence[Decisions]) -> tuple[Difference, ...]:
    """Return what changes from one plan to the other; recordings are told by their sequence, else by their files."""
    return tuple(
        difference
        for old, new in _pairs(before, after)
        for difference in (_recording(old, new) if old and new else [_alone(old, new)])
    )


def _pairs(
    before: Sequence[Decisions], after: Sequence[Decisions]
) -> Iterator[tuple[Decisions | None, Decisions | None]]:
    rest = list(after)
    unpaired: list[Decisions] = []
    for old in before:
        new = next((one for one in rest if one.sequence == old.sequence), None)
        if new is None:
            unpaired.append(old)
            continue
        rest.remove(new)
        yield old, new
    for old in unpaired:
        same = [one for one in rest if one.files == old.files]
        new = same[0] if same else rest[0] if len(rest) == len(unpaired) == 1 else None
        if new is not None:
            rest.remove(new)
        yield old, new
    yield from ((None, new) for new in rest)


def _alone(old: Decisions | None, new: Decisions | None) -> Difference:
    def shown(one: Decisions | None) -> str | None:
        return one and f"{', '.join(part.path for part in one.files)}, {len(one.topics)} topics"

    some = old or new
    return Difference(some.sequence if some else "", "recording", shown(old), shown(new))


def _recording(old: Decisions, new: Decisions) -> Iterator[Difference]:
    found = _mapping("", old.model_dump(mode="json"), new.model_dump(mode="json"))
    yield from (Difference(old.sequence, what, before, after) for what, before, after in found)


_Found: TypeAlias = "tuple[str, str | None, str | None]"


def _mapping(name: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Found]:
    for key in dict.fromkeys((*old, *new)):
        inner = f"{name} {key}".strip()
        if key not in old or key not in new:
            yield inner, _shown(old.get(key)), _shown(new.get(key))
        else:
            yield from _value(inner, key, old[key], new[key])


def _value(name: str, key: str, old: Json, new: Json) -> Iterator[_Found]:
    if old == new:
        return
    if isinstance(old, dict) and isinstance(new, dict):
        yield from _mapping(name, old, new)
    elif key in _NAMES:
        kind, identity = _NAMES[key]
        yield from _items(
            kind, {item[identity]: item for item in old}, {item[identity]: item for item in new}
        )
    else:
        yield name, _shown(old) or "none", _shown(new) or "none"


def _items(kind: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Found]:
    for identity in dict.fromkeys((*old, *new)):
        name = f"{kind} {identity}"
        if identity in old and identity in new:
            yield from _mapping(name, old[identity], new[identity])
        else:
            yield name, _summary(old.get(identity)), _summary(new.get(identity))


def _summary(item: Mapping[str, Json] | None) -> str | None:
    """Return what matters of an item that is on one side only."""
    if item is None:
        return None
    if "adapter" in item:
        return f"{item['msgtype']} by {item['adapter']} to {item['ontology']}"
    return item["why"] if "why" in item else f"{item['size_bytes']} bytes"


def _shown(value: Json) -> str | None:
    if value is None or isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)


def plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a plan file."""
    return document_schema(PlanDocument)
