"""This file sums a report up in Markdown, for the page of a CI job or a pull request."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.report.collect import (
    STEP_WORDS,
    longest_step,
    slowest,
    total_seconds,
)
from mosaico_ingest.report.model import Report, RunReport, replay_command
from mosaico_ingest.report.units import bytes_text, count_text, seconds_text

__all__ = ["markdown_summary"]

_SLOWEST = 3
_MOST_ROWS = 100
"""A job page takes a limited size; those with problems come first."""


def markdown_summary(report: RunReport) -> str:
    """Return headline, a row for each recording, and what was rejected or went wrong."""
    ordered = sorted(report.recordings, key=lambda one: one.exit_code == 0)
    lines = [f"## Ingestion: {report.headline}", ""]
    if ordered:
        lines += ["| sequence | status | read | written | rejected | stored | time |"]
        lines += ["|---|---|---:|---:|---:|---:|---:|", *map(_row, ordered[:_MOST_ROWS])]
    if len(ordered) > _MOST_ROWS:
        lines += ["", f"… and {len(ordered) - _MOST_ROWS} more, all of them in the report."]
    lines += _time(report)
    problems = list(_problems(ordered))
    if problems:
        lines += ["", "### To look at", "", *problems[:_MOST_ROWS]]
    commands = {f"    {command}" for one in ordered if (command := replay_command(report, one))}
    if commands:
        lines += ["", "Rejected messages were kept; once the manifest is mended:", "", *sorted(commands)]
    return "\n".join(lines) + "\n"


def _time(report: RunReport) -> list[str]:
    """Return where the time went, and which recordings took longest."""
    sums = total_seconds(report.recordings)
    if not sums:
        return []
    total = sum(sums.values())
    shares = ", ".join(f"{STEP_WORDS[name]} {spent / total:.0%}" for name, spent in sums.items())
    lines = ["", f"Time: {shares}."]
    if len(report.recordings) > 1:
        longest = (
            f"{_cell(one.sequence)} {seconds_text(one.duration_s)} ({longest_step(one.steps)})"
            for _, one in slowest(report.recordings, _SLOWEST)
        )
        lines += ["", f"Longest: {'; '.join(longest)}."]
    return lines


def _row(one: Report) -> str:
    totals = one.totals
    cells = (
        _cell(one.sequence),
        one.status.value,
        count_text(totals.read),
        count_text(totals.written),
        count_text(totals.rejected),
        bytes_text(totals.stored_bytes),
        seconds_text(one.duration_s),
    )
    return f"| {' | '.join(cells)} |"


def _problems(recordings: list[Report]) -> Iterator[str]:
    for one in recordings:
        if one.error:
            yield f"- **{_cell(one.sequence)}**: {_cell(one.error)}"
        for topic in one.topics:
            for rejection in topic.rejections:
                said = f"{count_text(rejection.count)} rejected [{rejection.rule}]: {rejection.reason}"
                yield f"- {_cell(one.sequence)} `{topic.target}`: {_cell(said)}"


def _cell(text: str) -> str:
    """Return text that neither ends a cell nor becomes markup."""
    for character in "\\|<>*`[]":
        text = text.replace(character, f"\\{character}")
    return " ".join(text.split())
