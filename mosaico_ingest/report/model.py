"""The report: what was read, written, excluded, rejected and unreadable, per topic and in total."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pydantic import ConfigDict, Field, computed_field

from mosaico_ingest.documents import Part, document_schema, read_document
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Stage
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.timing import TimelineReport
from mosaico_ingest.report.units import count_text, counted

__all__ = [
    "Rejection",
    "Report",
    "RunReport",
    "Steps",
    "TopicReport",
    "Totals",
    "UnreadableRange",
    "UsedManifest",
    "folder_link",
    "gravest",
    "read_report",
    "replay_command",
    "report_schema",
]

_GRAVEST_FIRST = (130, 5, 1, 2, 3, 4)


class _Part(Part):
    # What is computed is written for other readers, and left out again when a report is read back.
    model_config = ConfigDict(extra="ignore", defer_build=True)


class Rejection(_Part):
    """Messages of one topic that were rejected for the same reason."""

    stage: Stage
    """Where in the pipeline they were lost."""
    rule: str
    """The rule they broke."""
    count: int
    """How many."""
    reason: str
    """What was wrong with the first of them."""
    first_log_time_ns: int
    """When the first of them was recorded, ns since the epoch."""
    first_offset: int
    """Where the first of them lies in the source: file offset of its record or chunk, or row id."""


class UnreadableRange(_Part):
    """A stretch of the recording that could not be read."""

    topic: str | None
    """The topic, where it can be told."""
    count: int | None
    """How many messages, where the index says."""
    offset: int | None
    """Where in the file."""
    reason: str
    """What was found there."""


class TopicReport(_Part):
    """One topic: read = written + filtered + downsampled + rejected, always.

    Of a recording that was read to its end, promised = read + unreadable.
    """

    topic: str
    """Its name in the recording."""
    target: str
    """Its name in the sequence."""
    msgtype: str
    adapter: str
    ontology: str
    """The ontology tag its rows have."""
    why: str
    """Why this adapter, or why the topic was left out."""
    status: TopicStatus
    promised: int | None
    """How many messages the recording's index promises."""
    unreadable: int = 0
    """How many of them could not be read, as far as that can be told; `unreadable_ranges` says where."""
    read: int = 0
    written: int = 0
    filtered: int = 0
    downsampled: int = 0
    rejected: int = 0
    quarantined: int = 0
    """How many of the rejected are kept in the quarantine."""
    rejections: tuple[Rejection, ...] = ()
    start_ns: int | None = None
    """The first time stamp written, ns since the epoch."""
    end_ns: int | None = None
    """The last time stamp written, inclusive."""
    payload_bytes: int = 0
    """Size of the messages read, as they were serialised."""
    stored_bytes: int = 0
    """Size of the rows in the destination, as far as it says."""
    checksum: str | None = None
    """Of the values of the rows (XXH3, 128 bits), where the destination makes one; `ingest verify` makes it anew."""
    error: str | None = None
    timeline: TimelineReport | None = None
    """How the rows that were written spread over time."""

    @computed_field
    @property
    def rate_hz(self) -> float | None:
        """Rows a second over the topic's own span."""
        if self.start_ns is None or self.end_ns is None or self.end_ns <= self.start_ns:
            return None
        return round((self.written - 1) / ((self.end_ns - self.start_ns) / 1e9), 6)


class Totals(_Part):
    """Sums over the topics that were read."""

    promised: int | None
    """Number of messages in the index; None if the index does not count the messages of every topic."""
    unreadable: int | None
    """Number of messages in unreadable ranges; None if the number is unknown for a range."""
    read: int
    written: int
    filtered: int
    downsampled: int
    rejected: int
    payload_bytes: int
    stored_bytes: int


class Steps(_Part):
    """What a recording's time was spent on, in seconds; all but `write` add up to its duration."""

    prepare: float = 0
    """Opening it, planning, asking what the destination has."""
    read: float = 0
    """Reading and inflating, as far as the next step had to wait for it."""
    decode: float = 0
    """From bytes to columns."""
    adapt: float = 0
    """From the message's columns to those of its ontology type."""
    wait: float = 0
    """Waiting for the thread that writes."""
    commit: float = 0
    """Closing what was written, making it visible, checking it."""
    write: float = 0
    """How long that thread was busy, beside all of the above."""


class Report(_Part):
    """What became of one recording."""

    sequence: str
    destination: str
    files: tuple[str, ...]
    status: RunStatus
    exit_code: int
    error: str | None = None
    """The error that ended the run, in one line."""
    started_at: datetime
    duration_s: float
    source_bytes: int
    """Size of the recording's files."""
    steps: Steps = Steps()
    quarantine: str | None = None
    """The file that rejected messages were put into."""
    topics: tuple[TopicReport, ...] = ()
    unreadable_ranges: tuple[UnreadableRange, ...] = ()
    """What could not be read at all."""
    findings: tuple[str, ...] = ()
    """What there was to say about the recording."""

    @computed_field
    @property
    def totals(self) -> Totals:
        """Sums over the topics that were read."""
        taken = [topic for topic in self.topics if topic.status is not TopicStatus.EXCLUDED]
        promised = [topic.promised for topic in taken]
        unreadable = [item.count for item in self.unreadable_ranges]
        return Totals(
            promised=None if None in promised else sum(count or 0 for count in promised),
            unreadable=None if None in unreadable else sum(count or 0 for count in unreadable),
            read=sum(t.read for t in taken),
            written=sum(t.written for t in taken),
            filtered=sum(t.filtered for t in taken),
            downsampled=sum(t.downsampled for t in taken),
            rejected=sum(t.rejected for t in taken),
            payload_bytes=sum(t.payload_bytes for t in taken),
            stored_bytes=sum(t.stored_bytes for t in taken),
        )

    @computed_field
    @property
    def compression(self) -> float | None:
        """Stored bytes for each byte of the recording's files: below 1 it became smaller."""
        return round(self.totals.stored_bytes / self.source_bytes, 6) if self.source_bytes else None


class UsedManifest(_Part):
    """A manifest of the run, as it was when the run began."""

    path: str
    text: str
    """As YAML, with what it extends and without secrets."""


class RunReport(_Part):
    """What one call of the tool did: a report for each recording; `version` changes when the form does."""

    version: int = Field(default=1, ge=1)
    tool: str
    """Name and version of the program that wrote this."""
    manifests: tuple[UsedManifest, ...] = ()
    recordings: tuple[Report, ...]

    @property
    def headline(self) -> str:
        """How many recordings, what became of them, and how many messages were written."""
        failed = sum(one.exit_code not in {0, 4} for one in self.recordings)
        skipped = sum(one.status is RunStatus.SKIPPED for one in self.recordings)
        written = sum(one.totals.written for one in self.recordings)
        parts = [counted(len(self.recordings), "recording"), f"{count_text(failed)} failed"]
        parts += [f"{count_text(skipped)} skipped"] if skipped else []
        return f"{', '.join(parts)}, {counted(written, 'message')} written"

    @computed_field
    @property
    def exit_code(self) -> int:
        """That of the recordings' codes which comes first in 130, 5, 1, 2, 3, 4, 0: what another try may mend is not hidden."""
        return gravest([report.exit_code for report in self.recordings])


def gravest(codes: Sequence[int]) -> int:
    """Return the exit code of several recordings with these."""
    return next((code for code in _GRAVEST_FIRST if code in codes), max(codes, default=0))


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a report file."""
    return document_schema(RunReport)


def replay_command(report: RunReport, one: Report) -> str | None:
    """Return what to type once the manifest is mended; None where nothing was set aside."""
    if one.quarantine is None:
        return None
    manifests = [used.path for used in report.manifests]
    job = shlex.quote(manifests[0]) if len(manifests) == 1 else "JOB.yaml"
    return f"ingest replay {shlex.quote(str(Path(one.quarantine).parent))} --manifest {job}"


def folder_link(one: Report, page_folder: Path) -> str | None:
    """Return the link from a page in `page_folder` to the folder with the messages set aside."""
    if one.quarantine is None:
        return None
    folder = os.path.relpath(Path(one.quarantine).absolute().parent, page_folder.absolute())
    return quote(Path(folder).as_posix().encode("utf-8", "surrogateescape")) + "/"


def read_report(path: Path) -> RunReport:
    """Read a report file.

    Raises:
        ManifestError: The file does not exist or violates the schema of reports.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path)) from error
    return read_document(
        content, RunReport, where=str(path), kind="a report", hint="write one with `ingest run --report FILE`"
    )
