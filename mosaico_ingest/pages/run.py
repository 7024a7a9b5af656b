"""The page of a run: its recordings and its problems."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest.display import bytes_text, count_text, counted, percent_text, seconds_text
from mosaico_ingest.pages.design import macro, pack, render
from mosaico_ingest.pages.recording import (
    FAILED,
    RecordingView,
    StepShare,
    contract_summaries,
    step_shares,
)
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.recording import Report, slowest, step_seconds, unreadable_text
from mosaico_ingest.report.run import RunReport, replay_command
from mosaico_ingest.report.summaries import Comparison
from mosaico_ingest.rules import RULES

MAX_OPEN = 10
"""Recordings with problems that are expanded when the page opens, and whose content is not packed."""
MAX_ROWS = 50
"""Recordings above which the list is packed, except for its start."""
PACK_SIZE = 25
"""Recordings whose content is packed together."""
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
    several = len(report.recordings) > 1
    started_at = report.summary.started_at
    expectations = contract_summaries(report.recordings)
    return render(
        "run.html",
        report=report,
        list_link=list_link,
        verdict=verdict_of(report.recordings),
        problems=run_problems(report),
        expectations=expectations[:MAX_RESULTS],
        expectation_count=len(expectations),
        comparison=comparison,
        started_at=f"{started_at:%Y-%m-%d %H:%M:%S}" if started_at else None,
        totals=_totals(report),
        steps=_steps(report),
        writer_s=report.summary.steps.write,
        slowest=_slowest(report) if several else [],
        recordings=_list_recordings(report, None if list_link else folder or Path()),
    )


class Verdict(Struct, frozen=True):
    """The outcome of a run in one sentence."""

    kind: str
    """The class of its color: `good`, `warn`, `bad` or `none`."""
    title: str
    text: str


def verdict_of(recordings: Sequence[Report]) -> Verdict:
    """Return the gravest outcome of the recordings, with their numbers."""
    if not recordings:
        return Verdict("none", "No recording was ingested", "The job selected no recording.")
    failed = sum(one.status in FAILED for one in recordings)
    violations = sum(one.contract is not None and not one.contract.passed for one in recordings)
    incomplete = sum(one.status is RunStatus.WITH_ERRORS for one in recordings)
    skipped = sum(one.status is RunStatus.SKIPPED for one in recordings)
    counts = {
        "failed": failed,
        "with a violated contract": violations,
        "stored without some messages": incomplete,
        "already stored before": skipped,
    }
    parts = [f"{count_text(count)} {words}" for words, count in counts.items() if count]
    message_text = counted(sum(one.totals.written for one in recordings), "message")
    text = f"{counted(len(recordings), 'recording')}{': ' if parts else ''}{', '.join(parts)}; {message_text} written"
    if failed:
        title = "The run failed" if failed == len(recordings) else "The run failed for some recordings"
        return Verdict("bad", title, text)
    if violations:
        is_tolerated = all(one.contract is None or one.contract.on_failure == "warn" for one in recordings)
        return Verdict("warn" if is_tolerated else "bad", "The data violate the contract", text)
    if incomplete:
        return Verdict("warn", "Some messages are missing", text)
    if skipped == len(recordings):
        return Verdict("none", "Everything was already stored", text)
    return Verdict("good", "Everything was stored", text)


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


def run_problems(report: RunReport) -> list[Problem]:
    """Return the problems: failed recordings and violated contracts first, then by number of recordings."""
    groups: dict[tuple[str, ...], list[_Entry]] = {}
    for at, recording in enumerate(report.recordings):
        for entry in (
            *_failures(at, recording),
            *_violations(at, recording),
            *_missing(at, recording, report),
        ):
            groups.setdefault(entry.key, []).append(entry)
    problems = [_problem(entries, report.recordings) for entries in groups.values()]
    return sorted(problems, key=lambda problem: (not problem.is_error, -problem.count))


def _totals(report: RunReport) -> dict[str, str]:
    summary = report.summary
    source_bytes, stored_bytes = summary.source_bytes, summary.stored_bytes
    seconds, message_count = summary.duration_s, summary.read
    share = f" ({percent_text(stored_bytes / source_bytes)})" if source_bytes else ""
    return {
        "Recordings": count_text(len(report.recordings)),
        "Messages read": count_text(message_count),
        "Written": count_text(summary.written),
        "Rejected": count_text(summary.rejected),
        "Unreadable": unreadable_text(report.recordings),
        "Recorded": bytes_text(source_bytes),
        "Stored": f"{bytes_text(stored_bytes)}{share}",
        "Working time": seconds_text(seconds),
        "Messages / s": count_text(round(message_count / seconds)) if seconds else "",
    }


def _steps(report: RunReport) -> list[StepShare]:
    return step_shares(step_seconds(report.summary.steps), stacked=False)


def _slowest(report: RunReport) -> list[RecordingView]:
    return [RecordingView(at, report, Path()) for at, _ in slowest(report.recordings, MAX_SLOWEST)]


class _List(Struct, frozen=True):
    """The list of recordings: the elements that the page shows without scripts, and the packed ones."""

    items: Sequence[Markup]
    """The elements at the start of the list."""
    pack: Markup | None
    """All elements of the list; None if `items` has them all."""
    contents: Mapping[str, Markup]
    """The contents of elements that are not in them, by id of the pack."""


def _list_recordings(report: RunReport, folder: Path | None) -> _List:
    """Return the list with problems first. Contents are rendered together and compressed, beyond the first ones."""
    views = [RecordingView(at, report, folder) for at in range(len(report.recordings))]
    views.sort(key=lambda view: -view.rank)
    readable = len(views) if len(views) <= MAX_ROWS else MAX_OPEN
    items: list[Markup] = []
    for at, view in enumerate(views[:readable]):
        is_open = len(views) == 1 or (view.rank > 0 and at < MAX_OPEN)
        items.append(macro("recording.html", "item", view, is_open))
    contents: dict[str, Markup] = {}
    for start in range(readable, len(views), PACK_SIZE):
        part = views[start : start + PACK_SIZE]
        name = f"pack-{len(contents)}"
        contents[name] = pack([macro("recording.html", "content", view) for view in part])
        items += [macro("recording.html", "packed_item", view, name, at) for at, view in enumerate(part)]
    if len(items) <= MAX_ROWS:
        return _List(items, None, contents)
    return _List(items[:MAX_ROWS], pack(items), contents)


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


def _problem(entries: Sequence[_Entry], recordings: Sequence[Report]) -> Problem:
    first = entries[0]
    positions = list(dict.fromkeys(entry.at for entry in entries))
    commands = dict.fromkeys(entry.command for entry in entries if entry.command)
    links = tuple(RecordingLink(f"r{at}", recordings[at].sequence) for at in positions[:MAX_LINKS])
    return Problem(
        is_error=first.is_error,
        title=first.title(sum(entry.messages for entry in entries)),
        reason=first.reason,
        advice=first.advice,
        command=next(iter(commands), None),
        recordings=links,
        count=len(positions),
    )


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
