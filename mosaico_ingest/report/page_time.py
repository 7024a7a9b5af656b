"""This file is the part of the page that says what took the time."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.report.markup import Markup, element, join, table
from mosaico_ingest.report.model import Report, RunReport, Steps
from mosaico_ingest.report.slowness import STEP_WORDS, longest_step, slowest, step_seconds, total_seconds
from mosaico_ingest.report.units import bytes_text, count_text, seconds_text

__all__ = ["steps_line", "time_section"]

_MOST = 10
_WIDTH, _HEIGHT = 240, 16


def time_section(report: RunReport) -> Iterator[Markup]:
    """Yield the steps of all recordings, and the recordings that took longest."""
    sums = total_seconds(report.recordings)
    if not sums:
        return
    total = sum(sums.values())
    rows = [
        (
            join(element("span", class_=f"key {name}", aria_hidden="true"), STEP_WORDS[name]),
            seconds_text(seconds),
            f"{seconds / total:.0%}",
            _bar({name: seconds / total}),
        )
        for name, seconds in sums.items()
    ]
    writing = sum(one.steps.write for one in report.recordings)
    caption = f"Of all recordings; the writer was busy {seconds_text(writing)} beside them"
    yield join(
        element("h2", "Where the time went"), table(caption, ("Step", "Time", "Share", ""), rows, {1, 2})
    )
    if len(report.recordings) > 1:
        yield _slowest(slowest(report.recordings, _MOST))


def steps_line(steps: Steps) -> Markup | None:
    """Return one recording's steps as a line."""
    seconds = step_seconds(steps)
    if not any(seconds.values()):
        return None
    said = ", ".join(f"{STEP_WORDS[name]} {seconds_text(spent)}" for name, spent in seconds.items())
    return element("p", f"Time: {said}; the writer was busy {seconds_text(steps.write)}", class_="dim")


def _slowest(found: list[tuple[int, Report]]) -> Markup:
    head = ("Recording", "Time", "Size", "Messages a second", "Longest step", "Steps")
    rows = [
        (
            element("a", one.sequence, href=f"#r{at}"),
            seconds_text(one.duration_s),
            bytes_text(one.source_bytes),
            count_text(round(one.totals.read / one.duration_s)) if one.duration_s else "",
            longest_step(one.steps),
            _bar(_shares(one.steps)),
        )
        for at, one in found
    ]
    return table("The recordings that took longest", head, rows, {1, 2, 3})


def _shares(steps: Steps) -> dict[str, float]:
    seconds = step_seconds(steps)
    total = sum(seconds.values())
    return {name: spent / total for name, spent in seconds.items()}


def _bar(shares: dict[str, float]) -> Markup:
    """Draw shares of a whole, one after the other."""
    parts: list[Markup] = []
    start = 0.0
    for name, share in shares.items():
        width = share * _WIDTH
        parts.append(
            element("rect", class_=name, x=f"{start:.1f}", y="0", width=f"{width:.1f}", height=f"{_HEIGHT}")
        )
        start += width
    label = ", ".join(f"{STEP_WORDS[name]} {share:.0%}" for name, share in shares.items())
    return element(
        "svg",
        element("title", label),
        *parts,
        class_="steps",
        role="img",
        viewBox=f"0 0 {_WIDTH} {_HEIGHT}",
        preserveAspectRatio="none",
    )
