"""The report files of a folder, for the list of runs in the web server of a store."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.errors import IngestError
from mosaico_ingest.pages.run import Verdict, verdict_of
from mosaico_ingest.report.files import LINES_SUFFIX, read_report

MAX_RUNS = 200
"""Number of report files that are listed, the newest first."""
Signature = tuple[int, int]
"""Time of the last change in ns and size of a file."""


class RunSummary(Struct, frozen=True):
    """One report file in the list."""

    name: str
    """The name of the file."""
    started_at: datetime | None = None
    verdict: Verdict | None = None
    written: int = 0
    """Number of written messages."""
    sequences: tuple[str, ...] = ()
    problem: str | None = None
    """The reason why the file cannot be read."""


class ReportFolder:
    """The files `*.json` and `*.jsonl` of a folder; a file is read again only if it changes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._summaries: dict[str, tuple[Signature, RunSummary]] = {}

    def find(self, name: str) -> tuple[Path, Signature] | None:
        """Return a file of the folder by its name, which may come from anyone, with its signature."""
        return next(((path, signature) for path, signature in self._files() if path.name == name), None)

    def summaries(self, text: str = "") -> list[RunSummary]:
        """Return the newest runs whose name, or the name of one of their sequences, contains a text."""
        summaries = {
            path.name: self._summary(path, signature) for path, signature in self._files()[:MAX_RUNS]
        }
        needle = text.casefold()
        return [
            each
            for each in summaries.values()
            if any(needle in name.casefold() for name in (each.name, *each.sequences))
        ]

    def _files(self) -> list[tuple[Path, Signature]]:
        """Return the files, the newest first."""
        files: list[tuple[Path, Signature]] = []
        for path in (*self.path.glob("*.json"), *self.path.glob(f"*{LINES_SUFFIX}")):
            try:
                state = path.stat()
            except OSError:  # deleted since it was listed
                continue
            files.append((path, (state.st_mtime_ns, state.st_size)))
        return sorted(files, key=lambda file: file[1], reverse=True)

    def _summary(self, path: Path, signature: Signature) -> RunSummary:
        cached = self._summaries.get(path.name)
        if cached is None or cached[0] != signature:
            cached = self._summaries[path.name] = (signature, _summary(path))
        return cached[1]


def _summary(path: Path) -> RunSummary:
    try:
        report = read_report(path)
    except IngestError as error:
        return RunSummary(path.name, problem=str(error))
    return RunSummary(
        path.name,
        report.summary.started_at,
        verdict_of(report.recordings),
        report.summary.written,
        tuple(dict.fromkeys(each.sequence for each in report.recordings)),
    )
