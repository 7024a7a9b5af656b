"""Parts of all pages: templates, packed data, and drawings over time."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest import display
from mosaico_ingest.display import counted, seconds_text, time_text
from mosaico_ingest.findings import one_line
from mosaico_ingest.report.parts import TimelineReport

SCRIPTS = ("page.js",)
PLOT_SCRIPTS = ("vendor/uPlot.iife.min.js", "plots.js")
"""The scripts of pages with plots, in addition to `SCRIPTS`."""
WIDTH, HEIGHT = 300, 24
"""Size of a track, in its own units."""
MIN_BAR = 1.5
"""Width of the narrowest bar, so that a single row is visible."""
GAP_HEIGHT = 4
MARK_HEIGHT = 6
INTERVALS_PER_BAR = 4
"""Least number of median intervals per bar: shorter bars of a regular topic would look irregular."""
MAX_TICKS = 8
STEPS_S = (
    *(base * 10.0**exponent for exponent in range(-9, 1) for base in (1, 2, 5)),
    *(10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0, 3600.0, 7200.0, 14400.0, 28800.0, 86400.0),
)
"""Distances between the ticks of an axis, in s; beyond the last one, multiples of a day."""
Span = tuple[int, int]
"""Start and end, in ns since the epoch, both inclusive."""


def render(template: str, *, has_plots: bool = False, **values: object) -> str:
    """Return a page. `has_plots` adds the plotting library, which has 50 kB."""
    names = (*(PLOT_SCRIPTS if has_plots else ()), *SCRIPTS)
    scripts = [_script(name) for name in names]
    hashes = " ".join(f"'sha256-{_sha256(script)}'" for script in scripts)
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; form-action 'self'; base-uri 'none'; "
        f"script-src {hashes}"
    )
    page = (
        _environment()
        .get_template(template)
        .render(policy=policy, scripts=[Markup(script) for script in scripts], has_plots=has_plots, **values)  # noqa: S704 - package data
    )
    return page if page.endswith("\n") else f"{page}\n"


def macro(template: str, name: str, *arguments: object) -> Markup:
    """Return the HTML that a macro of a template writes."""
    html: Markup = getattr(_module(template), name)(*arguments)
    return html.strip()


def pack(parts: Sequence[str]) -> Markup:
    """Return texts of HTML compressed for `unpack` in `page.js`, which is about a tenth of their size."""
    compressed = zlib.compress(json.dumps(list(parts), ensure_ascii=False).encode(), 6)
    return Markup(base64.b64encode(compressed).decode())  # noqa: S704 - Base64 has no special characters


def data_element(value: Any) -> Markup:  # noqa: ANN401 - any JSON value
    """Return a value as JSON that can stand inside a script element."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    escaped = text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    return Markup(escaped)  # noqa: S704 - no character can end the script element


class Tick(Struct, frozen=True):
    """A tick of the axis."""

    percent: float
    """Position on the axis, 0 to 100."""
    label: str
    """Time since the start of the axis."""


class Axis(Struct, frozen=True):
    """The time axis of a recording or sequence."""

    start_ns: int
    end_ns: int
    ticks: tuple[Tick, ...]
    tick_percent: float
    """Distance between two ticks, 0 to 100; 0 without ticks."""

    @property
    def caption(self) -> str:
        """The start, the end and the duration."""
        duration = seconds_text((self.end_ns - self.start_ns) / 1e9)
        return f"{time_text(self.start_ns)} to {time_text(self.end_ns)} UTC ({duration})"

    @property
    def scale(self) -> float:
        """Units of a track per ns."""
        return WIDTH / (self.end_ns - self.start_ns) if self.end_ns > self.start_ns else 0.0

    def position(self, time_ns: int) -> float:
        """Return the position of a time on a track; times outside the axis are at its ends."""
        return min(max((time_ns - self.start_ns) * self.scale, 0.0), float(WIDTH))


class Track(Struct, frozen=True):
    """The SVG paths of one topic's rows, gaps, rejected and unreadable messages, and their description."""

    label: str
    rows: str
    gaps: str
    rejected: str
    unreadable: str


def time_axis(times_ns: Iterable[int]) -> Axis | None:
    """Return the axis from the smallest to the largest time; None without times."""
    times = sorted(times_ns)
    if not times:
        return None
    start_ns, end_ns = times[0], times[-1]
    duration_s = (end_ns - start_ns) / 1e9
    step_s = next((step for step in STEPS_S if step * MAX_TICKS >= duration_s), None)
    if step_s is None:
        step_s = 86400.0 * math.ceil(duration_s / 86400.0 / MAX_TICKS)
    if not duration_s:
        return Axis(start_ns, end_ns, (), 0.0)
    share = 100 * step_s / duration_s
    count = int(duration_s / step_s * (1 + 1e-9))
    ticks = (Tick(share * number, _tick_text(step_s * number, step_s)) for number in range(count + 1))
    return Axis(start_ns, end_ns, tuple(ticks), share)


def draw_track(
    axis: Axis,
    name: str,
    timeline: TimelineReport | None,
    *,
    span: Span | None = None,
    rejected: Sequence[Span] = (),
    unreadable: Sequence[Span] = (),
) -> Track:
    """Return the drawing of one topic on the axis; `span` is the time of its first and last row, if it is known."""
    rows = gaps = ""
    words: list[str] = []
    if timeline is not None:
        rows = _rows_path(_with_wider_bins(timeline, axis.scale), axis, span)
        gaps = _marks(
            axis, [(gap.start_ns, gap.end_ns) for gap in timeline.gaps], HEIGHT - GAP_HEIGHT, HEIGHT
        )
        words = [counted(sum(timeline.counts), "row"), gaps_text(timeline)]
    words += [f"rejected messages in {counted(len(rejected), 'range')}"] if rejected else []
    words += [f"{counted(len(unreadable), 'unreadable range')}"] if unreadable else []
    return Track(
        f"{name}: {', '.join(words) or 'no rows'}",
        rows,
        gaps,
        _marks(axis, rejected, 0, MARK_HEIGHT),
        _marks(axis, unreadable, 0, HEIGHT),
    )


def optional_span(start_ns: int | None, end_ns: int | None) -> Span | None:
    """Return the span between two times; None if one of them is unknown."""
    return None if start_ns is None or end_ns is None else (start_ns, end_ns)


def gaps_text(timeline: TimelineReport) -> str:
    """Return the number of gaps and the length of the longest, such as `2 gaps, 1.20 s the longest`."""
    if not timeline.gap_count:
        return "no gaps"
    longest_ns = max((gap.end_ns - gap.start_ns for gap in timeline.gaps), default=0)
    text = counted(timeline.gap_count, "gap")
    return f"{text}, {seconds_text(longest_ns / 1e9)}" + ("" if timeline.gap_count == 1 else " the longest")


@cache
def _environment() -> Environment:
    """Return the templates with autoescaping. Control characters of values are replaced by escapes."""

    def finalize(value: object) -> object:
        if isinstance(value, Markup) or not isinstance(value, str):
            return value
        return "\n".join(map(one_line, value.split("\n")))

    environment = Environment(
        loader=PackageLoader("mosaico_ingest.pages"),
        autoescape=True,
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    names = ("bytes_text", "count_text", "counted", "percent_text", "rate_text", "seconds_text", "time_text")
    environment.filters.update({name: getattr(display, name) for name in names})
    environment.filters["data"] = data_element
    return environment


@cache
def _module(template: str) -> Any:  # noqa: ANN401 - its attributes are the macros
    return _environment().get_template(template).module


@cache
def _script(name: str) -> str:
    environment = _environment()
    loader = environment.loader
    if loader is None:
        raise ValueError("the templates have no loader")
    return loader.get_source(environment, name)[0]


def _sha256(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _tick_text(seconds: float, step_s: float) -> str:
    if step_s >= 60 or seconds >= 600:  # noqa: PLR2004 - minutes
        minutes, rest = divmod(round(seconds), 60)
        hours, minutes = divmod(minutes, 60)
        return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if step_s >= size * 0.1:
            return f"{seconds / size:.4g} {unit}" if seconds else f"0 {unit}"
    return f"{seconds * 1e9:.0f} ns"


def _with_wider_bins(timeline: TimelineReport, scale: float) -> TimelineReport:
    """Merge bins until each is visible and spans several intervals, so that only gaps leave bins empty."""
    bins = len(timeline.counts)
    factor = math.ceil(INTERVALS_PER_BAR * (timeline.interval_ns or 0) / timeline.step_ns)
    if scale:
        factor = max(factor, math.ceil(MIN_BAR / (timeline.step_ns * scale)))
    factor = max(1, min(factor, bins))
    counts = tuple(sum(timeline.counts[at : at + factor]) for at in range(0, bins, factor))
    return timeline.model_copy(update={"step_ns": timeline.step_ns * factor, "counts": counts})


def _rows_path(timeline: TimelineReport, axis: Axis, span: Span | None) -> str:
    """Return the outline of all bars as one path; equal neighbors form one bar.

    A bin of a regular topic has one row more or less than the next one, and the first and the last bin are usually covered
    only in part. Their bars are as high as those of a typical bin.
    """
    typical = sorted(timeline.counts)[len(timeline.counts) // 2]
    counts = [typical if abs(count - typical) <= 1 and count else count for count in timeline.counts]
    bins = len(counts)
    if bins > 2:  # noqa: PLR2004 - both ends have a neighbor
        counts[0] = max(counts[0], counts[1])
        counts[-1] = max(counts[-1], counts[-2])
    left = (timeline.start_ns - axis.start_ns) * axis.scale
    step = timeline.step_ns * axis.scale
    if bins * step < MIN_BAR:
        left, step = min(max(left, 0.0), WIDTH - MIN_BAR), MIN_BAR / bins
    first, last = (0.0, float(WIDTH)) if span is None else (axis.position(span[0]), axis.position(span[1]))
    if last - first < MIN_BAR:
        first, last = 0.0, float(WIDTH)
    edges = [min(max(left + number * step, first), last) for number in range(bins + 1)]
    highest = max(1, *counts)
    moves = [f"M{edges[0]:.5g} {HEIGHT}"]
    level = 0
    for edge, count in zip(edges, counts, strict=False):
        height = math.ceil(count / highest * (HEIGHT - GAP_HEIGHT))
        if height != level:
            moves.append(f"H{edge:.5g}V{HEIGHT - height}")
            level = height
    moves.append(f"H{edges[-1]:.5g}V{HEIGHT}Z")
    return "".join(moves)


def _marks(axis: Axis, spans: Sequence[Span], top: int, bottom: int) -> str:
    """Return a rectangle for each span; spans outside the axis are omitted."""
    marks: list[str] = []
    for start_ns, end_ns in spans:
        if end_ns < axis.start_ns or start_ns > axis.end_ns:
            continue
        left, right = axis.position(start_ns), axis.position(end_ns)
        if right - left < MIN_BAR:
            left = min(left, WIDTH - MIN_BAR)
            right = left + MIN_BAR
        marks.append(f"M{left:.5g} {top}H{right:.5g}V{bottom}H{left:.5g}Z")
    return "".join(marks)
