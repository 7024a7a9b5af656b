"""This file is the plan as a file: what was decided about each recording, and what was seen while deciding."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

from pydantic import Field, JsonValue, ValidationError

from mosaico_ingest.diagnostics import Severity, Stage
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.policies import (
    IfExists,
    LoaderErrorPolicy,
    SessionLevelErrorPolicy,
    TopicLevelErrorPolicy,
)
from mosaico_ingest.report.part import Part
from mosaico_ingest.textfile import read_whole, write_whole

__all__ = [
    "Decisions",
    "DestinationState",
    "FilePart",
    "Kept",
    "Note",
    "PlanDocument",
    "PlannedTopic",
    "RecordingPlan",
    "Sample",
    "SampleRejection",
    "UnreadTopic",
    "read_plan",
    "write_plan",
]


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


class UnreadTopic(Part):
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
    left_out: tuple[UnreadTopic, ...]

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

    kind: Literal["store", "server"]
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
        ManifestError: It cannot be read, or is no plan of this version.
    """
    hint = "make one with `ingest plan job.yaml --out plan.json`"
    try:
        return PlanDocument.model_validate_json(read_whole(path))
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path), hint=hint) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        said = f"{place}: {first['msg']}" if place else first["msg"]
        raise ManifestError(f"this is no plan: {said}", where=str(path), hint=hint) from error


def write_plan(document: PlanDocument, path: Path) -> None:
    """Write a plan file, whole or not at all.

    Raises:
        ManifestError: It is a folder.
        SinkError: It cannot be written.
    """
    write_whole(path, document.model_dump_json(indent=2) + "\n")
