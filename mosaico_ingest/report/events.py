"""Events of a run: the display shows them while it runs, and `recording.Collector` turns them into the report."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from enum import Enum
from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from mosaico_ingest.findings import Finding, Stage

if TYPE_CHECKING:  # pydantic and NumPy are slow to import
    from mosaico_ingest.report.parts import ContractResult, Step, TimelineReport


DOWNSAMPLING = ("every", "rate")
"""The rules that drop messages regardless of their content."""


class RunStatus(str, Enum):
    """How the ingestion of one recording ended."""

    COMPLETED = "completed"
    WITH_ERRORS = "completed_with_errors"
    """Some rows were rejected or ranges unreadable; everything else was ingested."""
    DIVERTED = "diverted"
    """The recording violates its data contract and was stored under another name."""
    SKIPPED = "skipped"
    """The same content is already stored, or the run was a dry run."""
    FAILED = "failed"
    INTERRUPTED = "interrupted"


SUCCESSFUL = frozenset({0, 4})
"""Exit codes of recordings whose messages were written as far as possible."""


class TopicStatus(str, Enum):
    """How one topic ended."""

    WRITTEN = "written"
    EMPTY = "empty"
    """The recording has no message on the topic."""
    FINALIZED = "finalized"
    """Closed early by the `finalize` policy."""
    FAILED = "failed"
    """The destination or the adapter refused the topic; the `ignore` policy let the run continue."""
    EXCLUDED = "excluded"
    """Not selected, or not readable: no adapter, no definition, or another encoding than ROS."""


class Expected(Struct, frozen=True):
    """A topic of the plan, for the display and the report."""

    topic: str
    target: str
    msgtype: str
    adapter: str
    ontology: str
    why: str
    count: int | None
    """Number of messages in the index of the recording; None if it is unknown."""
    excluded: bool = False
    shares_messages: bool = False
    """True if another topic counts the same messages, because the adapter has several outputs."""


class RunStarted(Struct, frozen=True):
    """The recording is planned, and reading starts."""

    sequence: str
    destination: str
    files: tuple[str, ...]
    source_bytes: int
    topics: tuple[Expected, ...]


class TopicProgress(Struct, frozen=True):
    """More messages of one topic were processed; every number is an increment."""

    target: str
    read: int = 0
    written: int = 0
    """Number of messages that became rows, in this topic or another output of the adapter."""
    rows: int = 0
    """Number of rows; it differs from `written` if messages have any number of rows."""
    dropped: Mapping[str, int] = {}
    """Number of messages by the rule that drops them: `every`, `rate`, `where`, `on_change`, `time_range`, `drop_when` or
    `rows`."""
    latched: int = 0
    """Number of messages from before the time range."""
    stamp_fallbacks: int = 0
    """Number of messages without the time that `stamp` selects."""
    payload_bytes: int = 0
    start_ns: int | None = None
    end_ns: int | None = None


class Rejected(Struct, frozen=True):
    """Messages of one topic that were rejected for the same reason; `first_*` describes the first of them."""

    target: str
    stage: Stage
    rule: str
    count: int
    reason: str
    first_log_time_ns: int
    first_offset: int
    quarantined: int = 0
    """Number of these messages in the quarantine."""
    last_log_time_ns: int | None = None
    """Log time of the last of them; None if it is unknown."""


class Unreadable(Struct, frozen=True):
    """An unreadable range of the recording."""

    target: str | None
    """The topic in the sequence; None if the affected topics are unknown."""
    count: int | None
    """Number of unreadable messages; None if it is unknown."""
    offset: int | None
    """File offset or row id of the range."""
    reason: str
    start_ns: int | None = None
    """First log time of the range according to its index; None if unknown."""
    end_ns: int | None = None
    """Last log time of the range according to its index, inclusive; None if unknown."""


class Noted(Struct, frozen=True):
    """A finding that does not stop the run."""

    finding: Finding


class Quarantined(Struct, frozen=True):
    """Rejected messages were written to a file, from which they can be replayed."""

    messages: str
    """The path of the file."""


class TopicClosed(Struct, frozen=True):
    """The rows of a topic were committed or discarded."""

    target: str
    status: TopicStatus
    stored_bytes: int | None = None
    error: str | None = None
    timeline: TimelineReport | None = None
    checksum: str | None = None


class ContractEvaluated(Struct, frozen=True):
    """The expectations of the recording were evaluated."""

    result: ContractResult


class CommitStarted(Struct, frozen=True):
    """The session is about to be committed. An observer that raises here discards it."""


class Timed(Struct, frozen=True):
    """The seconds that each step of the run took."""

    seconds: Mapping[Step, float]


class RunFinished(Struct, frozen=True):
    """The run of the recording ended."""

    status: RunStatus
    exit_code: int
    error: str | None = None
    findings: tuple[Finding, ...] = ()
    """Findings of the error, with their locations."""


Event: TypeAlias = (
    RunStarted
    | TopicProgress
    | Rejected
    | Unreadable
    | Noted
    | Quarantined
    | TopicClosed
    | ContractEvaluated
    | CommitStarted
    | Timed
    | RunFinished
)
Observer: TypeAlias = Callable[[Event], None]
BatchObserver: TypeAlias = Callable[[int, Event], None]
"""Receives the position of a recording in its batch, and an event."""


def ignore_events(_event: Event) -> None:
    """Ignore an event: the default observer."""


def ignore_batch(_position: int, _event: Event) -> None:
    """Ignore an event: the default observer of a batch."""


@contextmanager
def log_level(level: str) -> Generator[None]:
    """Set the log level of the package inside a `with` block; the program configures the handlers."""
    logger = logging.getLogger("mosaico_ingest")
    previous = logger.level
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(previous)
