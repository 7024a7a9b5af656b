"""The problems of a run: equal failures, rejections and unreadable ranges of all recordings together, with advice."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence

from msgspec import Struct

from mosaico_ingest.pages.recording import FAILED
from mosaico_ingest.report.events import TopicStatus
from mosaico_ingest.report.files import RunReport, replay_command
from mosaico_ingest.report.model import Report
from mosaico_ingest.report.units import counted
from mosaico_ingest.rules import RULES

MAX_LINKS = 5
"""Recordings that a problem links to."""
HINT_SEPARATOR = " — "
"""Separates the problem of an error from its hint."""
DIGITS = re.compile(r"\d+")


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
