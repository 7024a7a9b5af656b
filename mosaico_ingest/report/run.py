"""The report of a run and its files: JSON documents, and JSON Lines to which a run appends each recording when it ends.

A file in JSON Lines has a header, a line for each recording, and a summary. The lines of several runs follow each other if
a run continues the report of an interrupted one; a recording then has the line of the last run that reported it.
"""

from __future__ import annotations

import shlex
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from functools import cached_property, reduce
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Annotated, Any, Literal, TypeVar

import msgspec
from pydantic import AfterValidator, BaseModel, Field, ValidationError, computed_field
from typing_extensions import Self

from mosaico_ingest.display import count_text, counted
from mosaico_ingest.documents import LineFile, document_schema, html_table, read_document
from mosaico_ingest.errors import ManifestError, SinkError, gravest
from mosaico_ingest.findings import join_names
from mosaico_ingest.lazy import LazySequence, concatenate
from mosaico_ingest.report.events import SUCCESSFUL, RunStatus
from mosaico_ingest.report.parts import ReportPart
from mosaico_ingest.report.recording import Report, Steps, topic_table

UNSUCCESSFUL = (RunStatus.FAILED, RunStatus.INTERRUPTED, RunStatus.DIVERTED)
"""Statuses of recordings that were not stored as the job demands."""
_SUMMED_TOTALS = ("read", "written", "filtered", "downsampled", "rejected", "stored_bytes")
_fcntl: Any = import_module("fcntl") if find_spec("fcntl") else None
"""File locks; None on Windows."""
LINES_SUFFIX = ".jsonl"
"""The suffix of report files in JSON Lines."""
_HINT = "write one with `ingest run --report FILE`"
_NO_RECORDINGS = '"recordings": []'
_Model = TypeVar("_Model", bound=BaseModel)


class UsedManifest(ReportPart):
    """A manifest of the run, as it was at the start."""

    path: str
    text: str
    """The manifest as YAML, with `extends` resolved and without secrets."""


class Summary(ReportPart):
    """Sums over the recordings of a run."""

    statuses: Mapping[RunStatus, int] = Field(default={})
    """Number of recordings by status."""
    read: int = 0
    written: int = 0
    filtered: int = 0
    downsampled: int = 0
    rejected: int = 0
    unreadable: int = 0
    """Number of unreadable messages, as far as it is known."""
    source_bytes: int = 0
    stored_bytes: int = 0
    duration_s: float = 0
    """Time spent on recordings; recordings that run at the same time add up."""
    steps: Steps = Steps()
    started_at: datetime | None = None
    """The time when the first recording started; None without recordings."""
    ended_at: datetime | None = None
    """The time when the last recording ended."""
    exit_code: int = 0
    """The first of 130, 5, 1, 2, 6, 3, 4, 0 that any recording produced."""
    resumed: int = 0
    """Number of recordings that an earlier run of the report finished and that the last run did not ingest again."""

    def including(self, report: Report) -> Summary:
        """Return the sums with another recording."""
        totals = report.totals
        ended_at = report.started_at + timedelta(seconds=report.duration_s)
        return self.replace(
            statuses={**self.statuses, report.status: self.statuses.get(report.status, 0) + 1},
            **{name: getattr(self, name) + getattr(totals, name) for name in _SUMMED_TOTALS},
            unreadable=self.unreadable + sum(item.count or 0 for item in report.unreadable_ranges),
            source_bytes=self.source_bytes + report.source_bytes,
            duration_s=round(self.duration_s + report.duration_s, 6),
            steps=Steps(
                **{name: round(getattr(self.steps, name) + seconds, 6) for name, seconds in report.steps}
            ),
            started_at=min(self.started_at or report.started_at, report.started_at),
            ended_at=max(self.ended_at or ended_at, ended_at),
            exit_code=gravest({self.exit_code, report.exit_code}),
        )

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return sum(self.statuses.values())

    @property
    def headline(self) -> str:
        """The numbers of recordings by outcome and of written messages, in one line."""
        failed = sum(self.statuses.get(status, 0) for status in UNSUCCESSFUL)
        skipped = self.statuses.get(RunStatus.SKIPPED, 0)
        parts = [counted(self.recordings, "recording"), f"{count_text(failed)} failed"]
        parts += [f"{count_text(self.resumed)} from earlier runs"] if self.resumed else []
        parts += [f"{count_text(skipped)} skipped"] if skipped else []
        return f"{', '.join(parts)}, {counted(self.written, 'message')} written"


class RunReport(ReportPart):
    """The report of one run, with a part for each recording; `version` changes with the format."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote the report."""
    manifests: tuple[UsedManifest, ...] = ()
    recordings: Annotated[Sequence[Report], AfterValidator(tuple)]
    """The result of each recording. If the report is a file in JSON Lines, each access reads the recording."""

    @computed_field
    @cached_property
    def summary(self) -> Summary:
        """The sums over all recordings."""
        return summarize(self.recordings)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; the sums are computed again if the recordings differ."""
        copy = super().model_copy(update=update, deep=deep)
        if update is not None and "recordings" in update:
            vars(copy).pop("summary", None)
        return copy

    def with_summary(self, summary: Summary) -> Self:
        """Return the report with sums that were computed before."""
        return self.model_copy(update={"summary": summary})

    @property
    def headline(self) -> str:
        """The numbers of recordings by outcome and of written messages, in one line."""
        return self.summary.headline

    @computed_field
    @property
    def exit_code(self) -> int:
        """The first of 130, 5, 1, 2, 6, 3, 4, 0 that any recording produced."""
        return self.summary.exit_code

    def __repr__(self) -> str:
        """Return the outcome, such as `<RunReport: 2 recordings, 0 failed, 4,220 messages written>`."""
        return f"<RunReport: {self.headline}>"

    def _repr_html_(self) -> str:
        """Return a table of the recordings for a notebook, or of the topics of a single recording."""
        if len(self.recordings) == 1:
            return topic_table(self.recordings[0])
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


class Header(ReportPart):
    """The first line of a run."""

    version: Literal[1] = 1
    tool: str
    """Name and version of the program that wrote the lines."""
    manifests: tuple[UsedManifest, ...] = ()


class Footer(ReportPart):
    """The last line of a run; it is missing if the run was killed."""

    summary: Summary
    """The sums over all recordings of the file."""


class ReportWriter:
    """Appends the recordings of a run to a file in JSON Lines.

    With `resume`, the lines of earlier runs in the file are kept. A recording that they finished and that this run skips
    gets no other line.

    Raises:
        ManifestError: The path has another suffix, or the file to continue is not a report, or one of another job.
        SinkError: The file cannot be written, or another run is writing it.
    """

    def __init__(self, path: Path, header: Header, *, resume: bool = False) -> None:
        if path.suffix != LINES_SUFFIX:
            raise ManifestError(
                f"the suffix of a report in JSON Lines is {LINES_SUFFIX}", where=str(path), hint="rename it"
            )
        self._index = _Index(path)
        self._summary = Summary()
        self._finished: set[int] = set()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab")
        except OSError as error:
            raise self._unwritable(error) from error
        try:
            self._lock()
            if resume:
                with path.open("rb") as file:
                    self._finished = self._index.read(file).finished
                self._index.refuse_other_job(header)
            self._file.truncate(self._index.end)  # also removes a line that a killed run did not complete
        except BaseException as error:
            self._file.close()
            if isinstance(error, OSError):
                raise self._unwritable(error) from error
            raise
        self._index.add_header(header)
        self._append(header)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._file.close()

    def has_finished(self, sequence: str, destination: str) -> bool:
        """Return whether an earlier run of the file finished a recording."""
        return _key(sequence, destination) in self._finished

    def add(self, report: Report) -> None:
        """Append the report of a recording.

        Raises:
            SinkError: The file cannot be written.
        """
        if report.status is RunStatus.SKIPPED and self.has_finished(report.sequence, report.destination):
            return
        self._index.add(report.sequence, report.destination, report.exit_code)
        self._append(report)
        self._summary = self._summary.including(report)

    def finish(self) -> RunReport:
        """Append the summary and return the report; each of its recordings is read from the file at each access.

        Raises:
            SinkError: The file cannot be written.
        """
        resumed = self._index.resumed
        summary = summarize(self._index.report().recordings) if resumed else self._summary
        summary = summary.replace(resumed=resumed)
        self._append(Footer(summary=summary))
        self._index.summary = summary
        return self._index.report()

    def _lock(self) -> None:
        """Lock the file until it is closed or the process ends; Windows and some network drives have no such lock."""
        if _fcntl is None:
            return
        try:
            _fcntl.flock(self._file, _fcntl.LOCK_EX | _fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise SinkError(
                "another run is writing the report",
                where=str(self._index.path),
                hint="name another file, or wait until the run ends",
            ) from error
        except OSError:
            return

    def _append(self, part: ReportPart) -> None:
        line = part.model_dump_json().encode() + b"\n"
        try:
            self._file.write(line)
            self._file.flush()
        except OSError as error:
            with suppress(OSError):  # closing flushes, too
                self._file.close()
            raise self._unwritable(error) from error
        self._index.end += len(line)

    def _unwritable(self, error: OSError) -> SinkError:
        return SinkError(f"cannot be written: {error.strerror}", where=str(self._index.path))


def summarize(recordings: Iterable[Report]) -> Summary:
    """Return the sums over recordings."""
    return reduce(Summary.including, recordings, Summary())


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


def read_report(path: Path) -> RunReport:
    """Read a report file; the recordings of a file in JSON Lines are read at each access.

    Raises:
        ManifestError: The file does not exist or violates the schema of reports.
    """
    try:
        if path.suffix == LINES_SUFFIX:
            with path.open("rb") as file:
                return _Index(path).read(file).report()
        content = path.read_bytes()
    except OSError as error:
        raise ManifestError(f"cannot be read: {error.strerror}", where=str(path)) from error
    return _parse_by_recording(content) or read_document(
        content, RunReport, where=str(path), kind="a report", hint=_HINT
    )


def combine(reports: Sequence[RunReport]) -> RunReport:
    """Return one report with the manifests and recordings of several."""
    if len(reports) == 1:
        return reports[0]
    return RunReport.model_construct(
        tool=reports[0].tool,
        manifests=tuple(dict.fromkeys(used for one in reports for used in one.manifests)),
        recordings=concatenate([LazySequence.of(one.recordings) for one in reports]),
    )


def report_text(report: RunReport, path: Path) -> Iterator[str]:
    """Yield the text of a report file, recording by recording: JSON Lines if the suffix of its path says so, else JSON."""
    if path.suffix == LINES_SUFFIX:
        yield Header(tool=report.tool, manifests=report.manifests).model_dump_json() + "\n"
        yield from (recording.model_dump_json() + "\n" for recording in report.recordings)
        yield Footer(summary=report.summary).model_dump_json() + "\n"
        return
    frame = RunReport(tool=report.tool, manifests=report.manifests, recordings=())
    start, end = frame.with_summary(report.summary).model_dump_json(indent=2).split(_NO_RECORDINGS)
    yield start + _NO_RECORDINGS[:-1]
    separator = "\n"
    for recording in report.recordings:
        yield separator + "    " + recording.model_dump_json(indent=2).replace("\n", "\n    ")
        separator = ",\n"
    yield ("]" if separator == "\n" else "\n  ]") + end + "\n"


class _Line(msgspec.Struct):
    """The values of a line that the index needs."""

    tool: str | None = None
    sequence: str | None = None
    destination: str = ""
    exit_code: int = 0


class _Index:
    """The positions of the recordings of a file in JSON Lines, which takes 24 bytes for each."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lines = LineFile(path)
        self.end = 0
        """The offset behind the last complete line."""
        self.summary: Summary | None = None
        """The sums over all recordings, if the last run was not killed."""
        self._tool = ""
        self._manifests: dict[UsedManifest, None] = {}
        self._runs: list[int] = []
        """The position of the first recording of each run."""
        self._offsets, self._keys, self._codes = array("q"), array("q"), array("q")

    def read(self, file: IO[bytes]) -> Self:
        """Add the lines of a file; an incomplete last line is ignored.

        Raises:
            ManifestError: The file is not a report in JSON Lines.
        """
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                break
            try:
                entry = msgspec.json.decode(line, type=_Line)
            except msgspec.MsgspecError as error:
                raise ManifestError(
                    f"is not a report: line {number}: {error}", where=str(self.path), hint=_HINT
                ) from error
            if entry.tool is not None or not self._runs:
                self.add_header(self._parse(line, Header, f"line {number}"))
            elif entry.sequence is not None:
                self.add(entry.sequence, entry.destination, entry.exit_code)
            else:
                self.summary = self._parse(line, Footer, f"line {number}").summary
            self.end += len(line)
        return self

    def add_header(self, header: Header) -> None:
        """Add a run whose header is at `end`."""
        self.summary = None
        self._tool = header.tool
        self._manifests.update(dict.fromkeys(header.manifests))
        self._runs.append(len(self._offsets))

    def add(self, sequence: str, destination: str, exit_code: int) -> None:
        """Add a recording whose line is at `end`."""
        self._offsets.append(self.end)
        self._keys.append(_key(sequence, destination))
        self._codes.append(exit_code)

    def refuse_other_job(self, header: Header) -> None:
        """Raise ManifestError if the file has recordings of other manifests than those of a run that continues it.

        A manifest is the same if its file or its content is.
        """
        earlier = [*self._manifests]
        others = [
            manifest.path
            for manifest in header.manifests
            if not any(
                manifest.text == one.text or Path(manifest.path).absolute() == Path(one.path).absolute()
                for one in earlier
            )
        ]
        if earlier and others:
            raise ManifestError(
                f"the report has recordings of {join_names(one.path for one in earlier)}, not of {join_names(others)}",
                where=str(self.path),
                hint="name another file with --report, or resume with the manifests of the report",
            )

    @property
    def finished(self) -> set[int]:
        """The keys of the recordings that were written."""
        return {self._keys[position] for position in self._latest() if self._codes[position] in SUCCESSFUL}

    @property
    def resumed(self) -> int:
        """Number of recordings whose line is of an earlier run than the last one."""
        return sum(position < self._runs[-1] for position in self._latest()) if len(self._runs) > 1 else 0

    def report(self) -> RunReport:
        """Return the report of all runs; each recording is read at each access."""
        latest = self._latest()
        report = RunReport.model_construct(
            tool=self._tool,
            manifests=tuple(self._manifests),
            recordings=LazySequence(lambda at: self._recording(latest[at]), range(len(latest)), ()),
        )
        return report if self.summary is None else report.with_summary(self.summary)

    def _latest(self) -> Sequence[int]:
        """Return the positions of the lines that no later run replaced."""
        if len(self._runs) <= 1:
            return range(len(self._offsets))
        later: set[int] = set()
        positions: list[int] = []
        for start, end in reversed(list(zip(self._runs, [*self._runs[1:], len(self._offsets)], strict=True))):
            positions += [at for at in reversed(range(start, end)) if self._keys[at] not in later]
            later.update(self._keys[start:end])
        return array("q", reversed(positions))

    def _recording(self, position: int) -> Report:
        offset = self._offsets[position]
        line = self._lines.read(offset)
        return self._parse(line, Report, f"byte {offset}")

    def _parse(self, line: bytes, model: type[_Model], position: str) -> _Model:
        try:
            return model.model_validate_json(line)
        except ValidationError:
            where = f"{self.path}: {position}"
            return read_document(line, model, where=where, kind="a report", hint=_HINT)


def _key(sequence: str, destination: str) -> int:
    """Return a number for a recording, which takes less memory than its names."""
    return hash((sequence, destination))


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
    computed = {"summary": report.summary.model_dump(mode="json"), "exit_code": report.exit_code}
    return report if all(values.get(name) == value for name, value in computed.items()) else None


def _parse_part(raw: msgspec.Raw, model: type[_Model]) -> _Model:
    part = model.model_validate_json(bytes(raw))
    if part.model_dump_json().encode() != msgspec.json.format(bytes(raw), indent=-1):
        raise ValueError("the values differ from the values that the model writes")
    return part
