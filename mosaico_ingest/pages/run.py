"""The page of a run: its recordings and its problems."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from heapq import nlargest
from pathlib import Path

from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest.display import bytes_text, count_text, counted, percent_text, seconds_text
from mosaico_ingest.pages.design import macro, pack, render
from mosaico_ingest.pages.recording import (
    FAILED,
    ContractSummaries,
    RecordingView,
    StepShare,
    problem_rank,
    step_shares,
)
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.recording import Report, at_least_text, step_seconds
from mosaico_ingest.report.run import RunReport, replay_command
from mosaico_ingest.report.summaries import Comparison
from mosaico_ingest.rules import RULES

MAX_OPEN = 10
"""Recordings with problems that are expanded when the page opens, and whose content is not packed."""
MAX_ROWS = 50
"""Recordings above which the list is packed, except for its start."""
PACK_SIZE = 25
"""Recordings whose content is packed together."""
MAX_LISTED = 5000
"""Recordings that the page lists; those with problems come first."""
MAX_PROBLEMS = 500
"""Different problems that the page lists."""
MAX_SLOWEST = 10
MAX_RESULTS = 200
"""Expectations that the table lists; failed ones come first."""
MAX_LINKS = 5
"""Recordings that a problem links to."""
HINT_SEPARATOR = " — "
"""Separates the problem of an error from its hint."""
DIGITS = re.compile(r"\d+")


def run_page(
    report: RunReport,
    folder: Path | None = None,
    comparison: Comparison | None = None,
    *,
    list_link: str | None = None,
) -> str:
    """Return the page; links to files are relative to `folder` (default: the current one), the page's folder.

    `list_link` is the address of the list of runs of a web server, which has no links to files.
    """
    overview = _Overview(report)
    started_at = report.summary.started_at
    expectations = overview.contracts.summaries()
    return render(
        "run.html",
        report=report,
        list_link=list_link,
        verdict=overview.verdict.verdict(),
        problems=overview.problems.problems(),
        expectations=expectations[:MAX_RESULTS],
        expectation_count=len(expectations),
        comparison=comparison,
        started_at=f"{started_at:%Y-%m-%d %H:%M:%S}" if started_at else None,
        totals=_totals(report, overview.unreadable),
        steps=_steps(report),
        writer_s=report.summary.steps.write,
        slowest=_slowest(report, overview.durations),
        recordings=_list_recordings(report, overview.ranks, None if list_link else folder or Path()),
    )


class Verdict(Struct, frozen=True):
    """The outcome of a run in one sentence."""

    kind: str
    """The class of its color: `good`, `warn`, `bad` or `none`."""
    title: str
    text: str


def verdict_of(recordings: Iterable[Report]) -> Verdict:
    """Return the gravest outcome of the recordings, with their numbers."""
    counts = _VerdictCounts()
    for recording in recordings:
        counts.add(recording)
    return counts.verdict()


class RecordingLink(Struct, frozen=True):
    """A recording on the page."""

    id: str
    sequence: str


class Problem(Struct, frozen=True):
    """What went wrong, why, and what to do."""

    is_error: bool
    """Whether recordings or contracts failed; otherwise messages are missing."""
    title: str
    reason: str
    advice: str
    command: str | None
    """A command that shows or fixes the problem."""
    recordings: tuple[RecordingLink, ...]
    count: int
    """Number of affected recordings."""


def _totals(report: RunReport, unreadable: str) -> dict[str, str]:
    summary = report.summary
    source_bytes, stored_bytes = summary.source_bytes, summary.stored_bytes
    seconds, message_count = summary.duration_s, summary.read
    share = f" ({percent_text(stored_bytes / source_bytes)})" if source_bytes else ""
    return {
        "Recordings": count_text(len(report.recordings)),
        "Messages read": count_text(message_count),
        "Written": count_text(summary.written),
        "Rejected": count_text(summary.rejected),
        "Unreadable": unreadable,
        "Recorded": bytes_text(source_bytes),
        "Stored": f"{bytes_text(stored_bytes)}{share}",
        "Working time": seconds_text(seconds),
        "Messages / s": count_text(round(message_count / seconds)) if seconds else "",
    }


def _steps(report: RunReport) -> list[StepShare]:
    return step_shares(step_seconds(report.summary.steps), stacked=False)


def _slowest(report: RunReport, durations: array[float]) -> list[RecordingView]:
    """Return the recordings with the longest duration if there are several; untimed recordings are excluded."""
    if len(durations) == 1:
        return []
    timed = (at for at, duration in enumerate(durations) if duration >= 0)
    longest = nlargest(MAX_SLOWEST, timed, key=lambda at: durations[at])
    return [RecordingView(at, report, Path()) for at in longest]


class _VerdictCounts:
    """The numbers of recordings by outcome."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._is_tolerated = True
        """Whether every violated contract only warns."""

    def add(self, recording: Report) -> None:
        """Count a recording."""
        contract = recording.contract
        self._counts["recordings"] += 1
        self._counts["failed"] += recording.status in FAILED
        self._counts["violations"] += contract is not None and not contract.passed
        self._counts["incomplete"] += recording.status is RunStatus.WITH_ERRORS
        self._counts["skipped"] += recording.status is RunStatus.SKIPPED
        self._counts["written"] += recording.totals.written
        self._is_tolerated &= contract is None or contract.on_failure == "warn"

    def verdict(self) -> Verdict:
        """Return the gravest outcome."""
        counts = self._counts
        if not counts["recordings"]:
            return Verdict("none", "No recording was ingested", "The job selected no recording.")
        words = {
            "failed": "failed",
            "violations": "with a violated contract",
            "incomplete": "stored without some messages",
            "skipped": "already stored before",
        }
        parts = [f"{count_text(counts[name])} {text}" for name, text in words.items() if counts[name]]
        recordings = f"{counted(counts['recordings'], 'recording')}{': ' if parts else ''}{', '.join(parts)}"
        text = f"{recordings}; {counted(counts['written'], 'message')} written"
        if counts["failed"]:
            is_complete = counts["failed"] == counts["recordings"]
            return Verdict(
                "bad", "The run failed" if is_complete else "The run failed for some recordings", text
            )
        if counts["violations"]:
            return Verdict("warn" if self._is_tolerated else "bad", "The data violate the contract", text)
        if counts["incomplete"]:
            return Verdict("warn", "Some messages are missing", text)
        if counts["skipped"] == counts["recordings"]:
            return Verdict("none", "Everything was already stored", text)
        return Verdict("good", "Everything was stored", text)


class _Overview:
    """The values of the page that depend on all recordings, which are read once."""

    def __init__(self, report: RunReport) -> None:
        self.verdict = _VerdictCounts()
        self.contracts = ContractSummaries()
        self.problems = _Problems(report)
        self.ranks = bytearray()
        self.durations = array("d")
        """Seconds of each recording; -1 if its steps were not timed."""
        unreadable: int = 0
        is_known = True
        for at, recording in enumerate(report.recordings):
            self.verdict.add(recording)
            self.contracts.add(at, recording)
            self.problems.add(at, recording)
            self.ranks.append(problem_rank(recording))
            is_timed = any(step_seconds(recording.steps).values())
            self.durations.append(recording.duration_s if is_timed else -1)
            for item in recording.unreadable_ranges:
                unreadable += item.count or 0
                is_known &= item.count is not None
        self.unreadable = count_text(unreadable) if is_known else at_least_text(unreadable)


class _List(Struct, frozen=True):
    """The list of recordings: the elements that the page shows without scripts, and the packed ones."""

    items: Sequence[Markup]
    """The elements at the start of the list."""
    pack: Markup | None
    """All elements of the list; None if `items` has them all."""
    contents: Mapping[str, Markup]
    """The contents of elements that are not in them, by id of the pack."""
    ids: Collection[str]
    """The ids of the elements."""


def _list_recordings(report: RunReport, ranks: bytearray, folder: Path | None) -> _List:
    """Return the list with problems first. Contents are rendered together and compressed, beyond the first ones."""
    order = sorted(range(len(ranks)), key=lambda at: -ranks[at])[:MAX_LISTED]
    readable = len(order) if len(order) <= MAX_ROWS else MAX_OPEN
    items: list[Markup] = []
    for number, at in enumerate(order[:readable]):
        view = RecordingView(at, report, folder)
        is_open = len(order) == 1 or (view.rank > 0 and number < MAX_OPEN)
        items.append(macro("recording.html", "item", view, is_open))
    contents: dict[str, Markup] = {}
    for start in range(readable, len(order), PACK_SIZE):
        part = [RecordingView(at, report, folder) for at in order[start : start + PACK_SIZE]]
        name = f"pack-{len(contents)}"
        contents[name] = pack([macro("recording.html", "content", view) for view in part])
        items += [macro("recording.html", "packed_item", view, name, at) for at, view in enumerate(part)]
    ids = {f"r{at}" for at in order}
    if len(items) <= MAX_ROWS:
        return _List(items, None, contents, ids)
    return _List(items[:MAX_ROWS], pack(items), contents, ids)


class _Entry(Struct, frozen=True):
    """One occurrence of a problem in a recording."""

    key: tuple[str, ...]
    at: int
    messages: int
    """Number of affected messages; 0 if it is unknown."""
    title: Callable[[int], str]
    reason: str
    advice: str
    command: str | None = None
    is_error: bool = False


class _Group:
    """The occurrences of a problem in all recordings."""

    def __init__(self, first: _Entry) -> None:
        self._first = first
        self._last = -1
        self._count = self._messages = 0
        self._links: list[RecordingLink] = []
        self._command: str | None = None

    def add(self, entry: _Entry, sequence: str) -> None:
        """Add an occurrence."""
        self._messages += entry.messages
        self._command = self._command or entry.command
        if entry.at != self._last:
            self._last = entry.at
            self._count += 1
            if len(self._links) < MAX_LINKS:
                self._links.append(RecordingLink(f"r{entry.at}", sequence))

    def problem(self) -> Problem:
        """Return the problem."""
        first = self._first
        return Problem(
            is_error=first.is_error,
            title=first.title(self._messages),
            reason=first.reason,
            advice=first.advice,
            command=self._command,
            recordings=tuple(self._links),
            count=self._count,
        )


class _Problems:
    """The problems of a run, at most `MAX_PROBLEMS` different ones."""

    def __init__(self, run: RunReport) -> None:
        self._run = run
        self._groups: dict[tuple[str, ...], _Group] = {}

    def add(self, at: int, recording: Report) -> None:
        """Add the problems of a recording."""
        for entry in (
            *_failures(at, recording),
            *_violations(at, recording),
            *_missing(at, recording, self._run),
        ):
            group = self._groups.get(entry.key)
            if group is None:
                if len(self._groups) >= MAX_PROBLEMS:
                    continue
                group = self._groups[entry.key] = _Group(entry)
            group.add(entry, recording.sequence)

    def problems(self) -> list[Problem]:
        """Return failed recordings and violated contracts first, then by number of recordings."""
        problems = [group.problem() for group in self._groups.values()]
        return sorted(problems, key=lambda problem: (not problem.is_error, -problem.count))


def _failures(at: int, report: Report) -> Iterator[_Entry]:
    if report.status in FAILED:
        problem, _, hint = (report.error or "the run ended early").rpartition(HINT_SEPARATOR)
        if not problem:
            problem, hint = hint, ""
        is_stopped = report.status.value == "interrupted"
        yield _Entry(
            key=("failed", DIGITS.sub("#", problem.rpartition(": ")[2]), hint),
            at=at,
            messages=0,
            title=lambda _: "Interrupted" if is_stopped else "Failed",
            reason=problem,
            advice=_sentence(hint) or ("Run the same command again." if is_stopped else ""),
            is_error=True,
        )
    for topic in report.topics:
        if topic.status is TopicStatus.FAILED and report.status not in FAILED:
            problem, _, hint = (topic.error or "the topic failed").partition(HINT_SEPARATOR)
            yield _Entry(
                key=("topic", topic.target, DIGITS.sub("#", problem)),
                at=at,
                messages=0,
                title=lambda _, name=topic.target: f"Topic {name} failed",
                reason=problem,
                advice=_sentence(hint),
                is_error=True,
            )


def _violations(at: int, report: Report) -> Iterator[_Entry]:
    for result in report.contract.errors if report.contract else ():
        location = f"{result.location.span}" if result.location else result.expectation
        yield _Entry(
            key=("contract", result.expectation, result.topic or ""),
            at=at,
            messages=0,
            title=lambda _, name=result.expectation: f"Expectation {name} failed",
            reason=result.line,
            advice=f"Correct the source of the data, or the expectation at {location} if the data are right.",
            is_error=True,
        )


def _missing(at: int, report: Report, run: RunReport) -> Iterator[_Entry]:
    for topic in report.topics:
        for rejection in topic.rejections:
            rule = RULES.get(rejection.rule)
            summary = f": {rule.summary}" if rule else ""
            command = replay_command(run, report) if topic.quarantined else None
            advice = (
                "Fix the mapping or the definition, then add the messages from the quarantine."
                if command
                else "Fix the mapping or the definition, then run the job again with `if_exists: replace`."
            )
            yield _Entry(
                key=("rejected", rejection.stage.value, rejection.rule),
                at=at,
                messages=rejection.count,
                title=lambda count, name=rejection.rule, text=summary: (
                    f"{counted(count, 'message')} rejected [{name}]{text}"
                ),
                reason=f"{topic.target}: {rejection.reason}",
                advice=advice,
                command=command or (f"ingest lint --explain {rejection.rule}" if rule else None),
            )
    for item in report.unreadable_ranges:
        yield _Entry(
            key=("unreadable", DIGITS.sub("#", item.reason)),
            at=at,
            messages=item.count or 0,
            title=lambda count: f"{counted(count, 'message')} unreadable" if count else "Unreadable ranges",
            reason=f"{item.topic}: {item.reason}" if item.topic else item.reason,
            advice="Copy the recording again from its source if the file is damaged; all other messages are stored.",
        )


def _sentence(hint: str) -> str:
    return f"{hint[0].upper()}{hint[1:]}{'' if hint[-1] in '.!?`' else '.'}" if hint else ""
