"""This file draws how a topic's rows spread over its recording: bars on one scale, gaps on the base line."""

from __future__ import annotations

import math
from collections.abc import Sequence

from mosaico_ingest.frozen import frozen
from mosaico_ingest.report.markup import Markup, element
from mosaico_ingest.report.model import TopicReport
from mosaico_ingest.report.timeline import TimelineReport
from mosaico_ingest.report.units import count_text, seconds_text

__all__ = ["Gap", "gaps", "sparkline"]

WIDTH, HEIGHT = 240, 24
_FEW = 4.0
"""Stretches are put together until they have that many rows on average, or a slow topic would look full of gaps."""
_LEAST_STRETCHES = 8


@frozen
class Gap:
    """A time without rows in the middle of a topic, ns since the epoch."""

    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.end_ns - self.start_ns) / 1e9


def gaps(timeline: TimelineReport) -> tuple[Gap, ...]:
    """Return the stretches without rows."""
    drawn = _coarser(timeline)
    found: list[Gap] = []
    for number, count in enumerate(drawn.counts):
        if count:
            continue
        start_ns = drawn.start_ns + number * drawn.step_ns
        if found and found[-1].end_ns == start_ns:
            start_ns = found.pop().start_ns
        found.append(Gap(start_ns, drawn.start_ns + (number + 1) * drawn.step_ns))
    return tuple(found)


def sparkline(topic: TopicReport, span: tuple[int, int]) -> Markup | None:
    """Draw a topic within the recording's span (first and last ns); None where it has no rows."""
    if topic.timeline is None:
        return None
    drawn = _coarser(topic.timeline)
    missing = gaps(topic.timeline)
    scale = WIDTH / max(span[1] - span[0], 1)
    start, step = (drawn.start_ns - span[0]) * scale, drawn.step_ns * scale
    label = f"{topic.target}: {count_text(topic.written)} rows, {_gap_text(missing)}"
    return element(
        "svg",
        element("title", label),
        element("path", class_="rows", d=_bars(drawn.counts, start, step)),
        element("path", class_="gaps", d=_ground(missing, span[0], scale)) if missing else None,
        role="img",
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        preserveAspectRatio="none",
    )


def _gap_text(missing: Sequence[Gap]) -> str:
    if not missing:
        return "no gap"
    longest = max(gap.seconds for gap in missing)
    return f"{len(missing)} gaps, the longest about {seconds_text(longest)}"


def _coarser(timeline: TimelineReport) -> TimelineReport:
    stretches = len(timeline.counts)
    wanted = math.ceil(_FEW * stretches / max(sum(timeline.counts), 1))
    factor = max(1, min(wanted, stretches // _LEAST_STRETCHES))
    counts = tuple(sum(timeline.counts[at : at + factor]) for at in range(0, stretches, factor))
    return TimelineReport(start_ns=timeline.start_ns, step_ns=timeline.step_ns * factor, counts=counts)


def _bars(counts: Sequence[int], start: float, step: float) -> str:
    """Return the outline of all bars as one path; equal neighbours are one bar."""
    most = max(counts)
    moves = [f"M{start:.1f} {HEIGHT}"]
    level = 0.0
    for number, count in enumerate(counts):
        height = round(count / most * (HEIGHT - 3), 1)
        if height != level:
            moves.append(f"H{start + number * step:.1f}V{HEIGHT - height:g}")
            level = height
    moves.append(f"H{start + len(counts) * step:.1f}V{HEIGHT}Z")
    return "".join(moves)


def _ground(missing: Sequence[Gap], first_ns: int, scale: float) -> str:
    return "".join(
        f"M{(gap.start_ns - first_ns) * scale:.1f} {HEIGHT - 3}H{(gap.end_ns - first_ns) * scale:.1f}V{HEIGHT}"
        f"H{(gap.start_ns - first_ns) * scale:.1f}Z"
        for gap in missing
    )
