"""This file is what the pipeline says while it runs; the display draws it, the report is its sum."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from mosaico_ingest.findings import Finding, Stage

if TYPE_CHECKING:  # pydantic and NumPy are slow to import
    from mosaico_ingest.report.timing import Step, TimelineReport

__all__ = [
    "BatchObserver",
    "Event",
    "Expected",
    "Noted",
    "Observer",
    "Quarantined",
    "Rejected",
    "RunFinished",
    "RunStarted",
    "RunStatus",
    "Timed",
    "TopicClosed",
    "TopicProgress",
    "TopicStatus",
    "Unreadable",
    "ignore_batch",
    "ignore_events",
]


class RunStatus(str, Enum):
    """How the ingestion of one recording ended."""

    COMPLETED = "completed"
    WITH_ERRORS = "completed_with_errors"
    """Everything that could be ingested was, but some messages could not."""
    SKIPPED = "skipped"
    """The same content is there already."""
    FAILED = "failed"
    INTERRUPTED = "interrupted"


class TopicStatus(str, Enum):
    """How one topic ended."""

    WRITTEN = "written"
    EMPTY = "empty"
    """The recording has the topic and no message of it."""
    FINALIZED = "finalized"
    """Closed early by the `finalize` policy."""
    FAILED = "failed"
    """The destination or the adapter refused the topic; the `ignore` policy let the others go on."""
    EXCLUDED = "excluded"
    """Not selected, or nothing here can read it."""


class Expected(Struct, frozen=True):
    """A topic of the plan, as the display and the report need it."""

    topic: str
    target: str
    msgtype: str
    adapter: str
    ontology: str
    why: str
    count: int | None
    """How many messages the index promises."""
    excluded: bool = False


class RunStarted(Struct, frozen=True):
    """The plan stands and the work begins."""

    sequence: str
    destination: str
    files: tuple[str, ...]
    source_bytes: int
    topics: tuple[Expected, ...]


class TopicProgress(Struct, frozen=True):
    """More messages of one stream went through; every number is an increment."""

    target: str
    read: int = 0
    written: int = 0
    filtered: int = 0
    downsampled: int = 0
    payload_bytes: int = 0
    start_ns: int | None = None
    end_ns: int | None = None


class Rejected(Struct, frozen=True):
    """Messages of one stream that could not go on for one reason; `first_*` is about the first of them."""

    target: str
    stage: Stage
    rule: str
    count: int
    reason: str
    first_log_time_ns: int
    first_offset: int
    quarantined: int = 0
    """How many of them lie in the quarantine."""


class Unreadable(Struct, frozen=True):
    """A stretch of the recording that could not be read."""

    target: str | None
    """None where it cannot be told which topics lost messages."""
    count: int | None
    offset: int | None
    reason: str


class Noted(Struct, frozen=True):
    """A finding about the recording that does not stop the run."""

    finding: Finding


class Quarantined(Struct, frozen=True):
    """Rejected messages lie in a file, from which they can be replayed."""

    messages: str
    """Its path."""


class TopicClosed(Struct, frozen=True):
    """A stream came to its end."""

    target: str
    status: TopicStatus
    stored_bytes: int | None = None
    error: str | None = None
    timeline: TimelineReport | None = None
    checksum: str | None = None


class Timed(Struct, frozen=True):
    """What the recording's time was spent on, in seconds."""

    seconds: Mapping[Step, float]


class RunFinished(Struct, frozen=True):
    """The recording is done with, one way or another."""

    status: RunStatus
    exit_code: int
    error: str | None = None
    findings: tuple[Finding, ...] = ()
    """What the error knows of the places it is about."""


Event: TypeAlias = (
    RunStarted
    | TopicProgress
    | Rejected
    | Unreadable
    | Noted
    | Quarantined
    | TopicClosed
    | Timed
    | RunFinished
)
Observer: TypeAlias = Callable[[Event], None]
BatchObserver: TypeAlias = Callable[[int, Event], None]
"""Told which configuration of a batch an event is about, by its position, and the event."""


def ignore_events(_event: Event) -> None:
    """Do nothing: the default observer."""


def ignore_batch(_position: int, _event: Event) -> None:
    """Do nothing: the default observer of a batch."""
