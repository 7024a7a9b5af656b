"""The report: the numbers of read, written, excluded, rejected and unreadable messages, per topic and in total."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import msgspec
from pydantic import BaseModel, computed_field

from mosaico_ingest.documents import document_schema, read_document
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.findings import Stage, one_line
from mosaico_ingest.notebook import html_table
from mosaico_ingest.report.contract import ContractResult, ReportPart
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.timing import TimelineReport, mean_rate_hz
from mosaico_ingest.report.units import bytes_text, count_text, counted, written_cell, written_text

_GRAVEST_FIRST = (130, 5, 1, 2, 6, 3, 4)


_Model = TypeVar("_Model", bound=BaseModel)


class Stretch(ReportPart):
    """A range of time, both ends inclusive."""

    start_ns: int
    """First log time, in ns since the epoch."""
    end_ns: int
    """Last log time, in ns since the epoch."""


class Rejection(ReportPart):
    """Messages of one topic that were rejected for the same reason."""

    stage: Stage
    """The stage that rejected the messages."""
    rule: str
    """The id of the rule that the messages violate."""
    count: int
    """Number of messages."""
    reason: str
    """The reason for the first message."""
    first_log_time_ns: int
    """Log time of the first message, in ns since the epoch."""
    first_offset: int
    """Location of the first message in the recording: file offset of its record or chunk, or row id."""
    stretches: tuple[Stretch, ...] = ()
    """Ranges of log times in which messages were rejected, ordered by time; neighbors are merged beyond 50."""


class UnreadableRange(ReportPart):
    """A range of the recording from which messages could not be read."""

    topic: str | None
    """The topic; None if it is unknown."""
    count: int | None
    """Number of unreadable messages; None if it is unknown."""
    offset: int | None
    """File offset or row id; None if it is unknown."""
    reason: str
    """What was expected and what the file contains."""
    start_ns: int | None = None
    """First log time of the range according to the recording's index; None if it is unknown."""
    end_ns: int | None = None
    """Last log time of the range according to the recording's index, inclusive; None if it is unknown."""


class TopicReport(ReportPart):
    """One topic: read = written + filtered + downsampled + rejected.

    If the recording was read completely, promised = read + unreadable.
    """

    topic: str
    """The name in the recording."""
    target: str
    """The name in the sequence."""
    msgtype: str
    adapter: str
    ontology: str
    """The ontology tag of the rows."""
    why: str
    """The reason for the adapter, or for the exclusion of the topic."""
    status: TopicStatus
    promised: int | None
    """Number of messages in the index of the recording; None if it is unknown."""
    unreadable: int = 0
    """Number of messages that could not be read, as far as it is known; see `unreadable_ranges`."""
    read: int = 0
    written: int = 0
    """Number of messages that became rows, in this topic or another output of its adapter."""
    rows: int = 0
    """Number of rows; it differs from `written` if the adapter has `rows` or several outputs."""
    shares_messages: bool = False
    """True if another topic counts the same messages, because the adapter has several outputs; totals count them once."""
    filtered: int = 0
    """Number of messages that `where`, `on_change`, the time range or the adapter dropped after they were read."""
    downsampled: int = 0
    """Number of messages that `every` or `rate` dropped."""
    dropped: Mapping[str, int] = {}
    """Number of filtered and downsampled messages by rule: `every`, `rate`, `where`, `on_change`, `time_range`, and of the
    adapter `drop_when` and `rows` (an empty list)."""
    latched: int = 0
    """Number of messages from before the time range, see `bag.time.include_latched`."""
    stamp_fallbacks: int = 0
    """Number of messages that have their log time, because they do not have the time that `stamp` selects."""
    rejected: int = 0
    quarantined: int = 0
    """Number of rejected messages in the quarantine."""
    rejections: tuple[Rejection, ...] = ()
    start_ns: int | None = None
    """The first timestamp of the rows, in ns since the epoch."""
    end_ns: int | None = None
    """The last timestamp of the rows, in ns since the epoch, inclusive."""
    payload_bytes: int = 0
    """Serialized bytes of the messages read."""
    stored_bytes: int = 0
    """Bytes of the rows in the destination, as far as it reports them."""
    checksum: str | None = None
    """XXH3 checksum (128 bits) of the row values; None if the destination has none. `ingest verify` computes it again."""
    error: str | None = None
    timeline: TimelineReport | None = None
    """The distribution of the written rows over time."""

    @computed_field
    @property
    def rate_hz(self) -> float | None:
        """Rows per second; see `mean_rate_hz`."""
        rate = mean_rate_hz(self.rows, self.start_ns, self.end_ns)
        return None if rate is None else round(rate, 6)


class Totals(ReportPart):
    """Sums over the topics that were read."""

    promised: int | None
    """Number of messages in the index; None if the index does not count the messages of every topic."""
    unreadable: int | None
    """Number of messages in unreadable ranges; None if the number is unknown for a range."""
    read: int
    written: int
    rows: int
    """Number of rows in all topics."""
    filtered: int
    downsampled: int
    rejected: int
    payload_bytes: int
    stored_bytes: int


class Steps(ReportPart):
    """Seconds per step of a run; all steps but `write` add up to its duration."""

    prepare: float = 0
    """Opening and planning the recording, and inspecting the destination."""
    read: float = 0
    """Reading and decompressing, as far as decoding had to wait."""
    decode: float = 0
    """Decoding bytes into columns of the ROS type."""
    adapt: float = 0
    """Converting columns of the ROS type into columns of the ontology type."""
    wait: float = 0
    """Waiting for the writing thread."""
    commit: float = 0
    """Finishing, committing and verifying the sequence."""
    write: float = 0
    """Time that the writing thread was busy, in parallel to the other steps."""


class Report(ReportPart):
    """The result of one recording."""

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
    """Bytes of the recording's files."""
    steps: Steps = Steps()
    quarantine: str | None = None
    """The file with the rejected messages."""
    contract: ContractResult | None = None
    """The results of the data contract; None without a contract, or if the recording was not read completely."""
    topics: tuple[TopicReport, ...] = ()
    unreadable_ranges: tuple[UnreadableRange, ...] = ()
    findings: tuple[str, ...] = ()
    """The findings of the run, one line each."""

    @computed_field
    @property
    def totals(self) -> Totals:
        """Sums over the topics that were read."""
        topics = self.counted_topics
        promised = [topic.promised for topic in topics]
        unreadable = [item.count for item in self.unreadable_ranges]
        return Totals(
            promised=None if None in promised else sum(count or 0 for count in promised),
            unreadable=None if None in unreadable else sum(count or 0 for count in unreadable),
            read=sum(t.read for t in topics),
            written=sum(t.written for t in topics),
            rows=sum(t.rows for t in self.topics),
            filtered=sum(t.filtered for t in topics),
            downsampled=sum(t.downsampled for t in topics),
            rejected=sum(t.rejected for t in topics),
            payload_bytes=sum(t.payload_bytes for t in topics),
            stored_bytes=sum(t.stored_bytes for t in self.topics),
        )

    @property
    def counted_topics(self) -> list[TopicReport]:
        """The topics that were read, except topics that share their messages with another topic."""
        return [
            topic
            for topic in self.topics
            if topic.status is not TopicStatus.EXCLUDED and not topic.shares_messages
        ]

    def __repr__(self) -> str:
        """Return the outcome, such as `<Report yard: completed, 2,110 of 2,110 messages written>`."""
        outcome = self.error or written_text(self)
        return one_line(f"<Report {self.sequence}: {self.status.value}, {outcome}>")

    def _repr_html_(self) -> str:
        """Return a table of the topics for a notebook."""
        return _topic_table(self)

    @computed_field
    @property
    def compression(self) -> float | None:
        """Stored bytes per byte of the recording's files; None if their size is unknown."""
        return round(self.totals.stored_bytes / self.source_bytes, 6) if self.source_bytes else None


class UsedManifest(ReportPart):
    """A manifest of the run, as it was at the start."""

    path: str
    text: str
    """The manifest as YAML, with `extends` resolved and without secrets."""


class RunReport(ReportPart):
    """The report of one run, with a part for each recording; `version` changes with the format."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote the report."""
    manifests: tuple[UsedManifest, ...] = ()
    recordings: tuple[Report, ...]

    @property
    def headline(self) -> str:
        """The numbers of recordings by outcome and of written messages, in one line."""
        failed = sum(one.exit_code not in {0, 4} for one in self.recordings)
        skipped = sum(one.status is RunStatus.SKIPPED for one in self.recordings)
        written = sum(one.totals.written for one in self.recordings)
        parts = [counted(len(self.recordings), "recording"), f"{count_text(failed)} failed"]
        parts += [f"{count_text(skipped)} skipped"] if skipped else []
        return f"{', '.join(parts)}, {counted(written, 'message')} written"

    def __repr__(self) -> str:
        """Return the outcome, such as `<RunReport: 2 recordings, 0 failed, 4,220 messages written>`."""
        return f"<RunReport: {self.headline}>"

    def _repr_html_(self) -> str:
        """Return a table of the recordings for a notebook, or of the topics of a single recording."""
        if len(self.recordings) == 1:
            return _topic_table(self.recordings[0])
        rows = (
            (
                each.sequence,
                each.status.value,
                *(
                    count_text(count)
                    for count in (each.totals.read, each.totals.written, each.totals.rejected)
                ),
                each.error or "",
            )
            for each in self.recordings
        )
        names = ("sequence", "status", "read", "written", "rejected", "error")
        return html_table(
            self.headline, names, rows, count=len(self.recordings), numbers={"read", "written", "rejected"}
        )

    @computed_field
    @property
    def exit_code(self) -> int:
        """The first of 130, 5, 1, 2, 6, 3, 4, 0 that any recording produced."""
        return gravest([report.exit_code for report in self.recordings])


def _topic_table(report: Report) -> str:
    """Return the topics that were read as a table for a notebook."""
    topics = [topic for topic in report.topics if topic.status is not TopicStatus.EXCLUDED]
    excluded = len(report.topics) - len(topics)
    rows = (
        (
            topic.target,
            topic.ontology,
            count_text(topic.read),
            written_cell(topic.written, topic.rows),
            count_text(topic.rejected),
            bytes_text(topic.stored_bytes),
        )
        for topic in topics
    )
    names = ("topic", "ontology", "read", "written", "rejected", "stored")
    notes = [*([f"excluded: {counted(excluded, 'topic')}"] if excluded else []), *report.findings]
    return html_table(repr(report)[1:-1], names, rows, count=len(topics), numbers=names[2:], notes=notes)


def gravest(codes: Sequence[int]) -> int:
    """Return the exit code of a run whose recordings have these exit codes."""
    return next((code for code in _GRAVEST_FIRST if code in codes), max(codes, default=0))


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a report file."""
    return document_schema(RunReport)


def replay_command(report: RunReport, one: Report) -> str | None:
    """Return the command that replays the quarantine of a recording; None if it has none."""
    if one.quarantine is None:
        return None
    manifests = [manifest.path for manifest in report.manifests]
    job = shlex.quote(manifests[0]) if len(manifests) == 1 else "JOB.yaml"
    return f"ingest replay {shlex.quote(str(Path(one.quarantine).parent))} --manifest {job}"


def folder_link(one: Report, page_folder: Path) -> str | None:
    """Return the link from a page in `page_folder` to the folder of the quarantine; None if there is none."""
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
    return _parse_by_recording(content) or read_document(
        content, RunReport, where=str(path), kind="a report", hint="write one with `ingest run --report FILE`"
    )


def _parse_by_recording(content: bytes) -> RunReport | None:
    """Return the report if the model writes each of its parts byte for byte the same, apart from white space; else None.

    Such a report satisfies the published schema, against which validation takes ten times as long. The recordings are
    parsed one by one, because the objects of a complete JSON document need several times the memory of its models.
    """
    models = {"manifests": UsedManifest, "recordings": Report}
    try:
        members = msgspec.json.decode(content, type=dict[str, msgspec.Raw])
        if not members.keys() <= {*RunReport.model_fields, *RunReport.model_computed_fields}:
            return None
        values = {
            name: tuple(
                _parse_part(part, models[name]) for part in msgspec.json.decode(raw, type=list[msgspec.Raw])
            )
            if name in models
            else msgspec.json.decode(raw)
            for name, raw in members.items()
        }
        report = RunReport.model_validate(values, strict=True)
    except ValueError:  # the base class of the errors of msgspec and pydantic
        return None
    return report if report.exit_code == values.get("exit_code") else None


def _parse_part(raw: msgspec.Raw, model: type[_Model]) -> _Model:
    part = model.model_validate_json(bytes(raw))
    if part.model_dump_json().encode() != msgspec.json.format(bytes(raw), indent=-1):
        raise ValueError("the values differ from the values that the model writes")
    return part
