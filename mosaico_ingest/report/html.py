"""The report as one self-contained HTML page."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from importlib.resources import files
from itertools import islice
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.report.collect import (
    STEP_WORDS,
    longest_step,
    slowest,
    step_seconds,
    total_seconds,
)
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.model import Report, RunReport, Steps, TopicReport, folder_link, replay_command
from mosaico_ingest.report.timing import TimelineReport
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    counted,
    seconds_text,
    time_text,
)

__all__ = [
    "STATUS_WORDS",
    "Gap",
    "Markup",
    "element",
    "gaps",
    "html_page",
    "join",
    "sparkline",
    "steps_line",
    "table",
    "time_section",
]

_VOID = {"input", "meta", "link", "br"}


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(name: str, /, *children: str | None, **attributes: str | bool | None) -> Markup:
    """Return an element; `class_` is `class`, `_` in other attributes is `-`, None and False leave one out."""
    given = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _VOID:
        return Markup(f"<{name}{given}>")
    return Markup(f"<{name}{given}>{join(*children)}</{name}>")


def join(*children: str | None) -> Markup:
    """Return the children one after the other; None is nothing."""
    return Markup("".join(_text(child) for child in children if child is not None))


def table(caption: str, head: tuple[str, ...], rows: Iterable[tuple[str, ...]], numbers: set[int]) -> Markup:
    """Return a table that scrolls by itself; `numbers` are the columns to align on the right."""

    def kind(column: int) -> str | None:
        return "n" if column in numbers else None

    titles = (element("th", name, scope="col", class_=kind(at)) for at, name in enumerate(head))
    lines = (
        element(
            "tr",
            element("th", row[0], scope="row"),
            *(element("td", cell, class_=kind(at)) for at, cell in enumerate(row[1:], 1)),
        )
        for row in rows
    )
    table = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *titles)),
        element("tbody", *lines),
    )
    return element("div", table, class_="table", tabindex="0", role="region", aria_label=caption)


def _text(child: str) -> str:
    return child if isinstance(child, Markup) else escape(child)


def _attribute(key: str, value: str | bool | None) -> str:  # noqa: FBT001 - HTML's own way
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escape(value)}"'


WIDTH, HEIGHT = 240, 24
_FEW = 4.0
"""Stretches are put together until they have that many rows on average, or a slow topic would look full of gaps."""
_LEAST_STRETCHES = 8


class Gap(Struct, frozen=True):
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


STATUS_WORDS = {
    RunStatus.COMPLETED: "completed",
    RunStatus.REJECTED: "completed, some messages rejected",
    RunStatus.SKIPPED: "skipped, it is there already",
    RunStatus.FAILED: "failed",
    RunStatus.INTERRUPTED: "interrupted",
}
_BAD = {RunStatus.FAILED, RunStatus.INTERRUPTED}
_OPEN = 3
"""That many recordings are shown open."""


def html_page(report: RunReport, folder: Path | None = None) -> str:
    """Return the whole page; links to files start in `folder` (the current one), where the page will lie."""
    folder = folder or Path()
    title = f"Ingestion report: {_headline(report)}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", _asset("page.css")),
    )
    body = element(
        "body",
        element("a", "Skip to the recordings", class_="skip", href="#recordings"),
        element("header", element("h1", "Ingestion report"), _subtitle(report)),
        element(
            "main",
            _sums(report),
            *_look_at(report, folder),
            *time_section(report),
            _recordings(report, folder),
            *_manifests(report),
        ),
        element("script", _asset("page.js")) if report.recordings else None,
    )
    return f"<!doctype html>\n{element('html', head, body, lang='en')}\n"


def _asset(name: str) -> Markup:
    return Markup((files("mosaico_ingest.report") / name).read_text(encoding="utf-8"))


def _headline(report: RunReport) -> str:
    if not report.recordings:
        return "nothing was ingested"
    bad = sum(one.status in _BAD for one in report.recordings)
    return f"{counted(len(report.recordings), 'recording')}, {count_text(bad) if bad else 'none'} failed"


def _subtitle(report: RunReport) -> Markup:
    began = min((one.started_at for one in report.recordings), default=None)
    when = f", begun {began:%Y-%m-%d %H:%M:%S} UTC" if began else ""
    return element("p", f"{_headline(report)} ({report.tool}{when})", class_="dim")


def _sums(report: RunReport) -> Markup:
    totals = [one.totals for one in report.recordings]
    source = sum(one.source_bytes for one in report.recordings)
    stored = sum(one.stored_bytes for one in totals)
    topics = [topic for one in report.recordings for topic in one.topics]
    sums = {
        "Recordings": count_text(len(report.recordings)),
        "Messages read": count_text(sum(one.read for one in totals)),
        "Written": count_text(sum(one.written for one in totals)),
        "Rejected": count_text(sum(one.rejected for one in totals)),
        "Unreadable": count_text(sum(topic.unreadable for topic in topics)),
        "Recordings' size": bytes_text(source),
        "Stored size": f"{bytes_text(stored)}{f', {stored / source:.0%}' if source else ''}",
        "Working time": seconds_text(sum(one.duration_s for one in report.recordings)),
    }
    return element(
        "dl", *(element("div", element("dt", k), element("dd", v)) for k, v in sums.items()), class_="sums"
    )


def _look_at(report: RunReport, folder: Path) -> Iterator[Markup]:
    """Yield what somebody has to look at: recordings that failed, messages that were rejected, by reason."""
    failed = [(at, one) for at, one in enumerate(report.recordings) if one.status in _BAD]
    if failed:
        items = (element("li", _link(at, one), f": {one.error or one.status.value}") for at, one in failed)
        yield join(element("h2", "Failed recordings"), element("ul", *items))
    rows = list(_rejections(report, folder))
    if rows:
        head = ("Stage", "Rule", "Messages", "Recordings", "The first reason", "Kept in")
        yield join(
            element("h2", "Rejected messages by reason"), table("Of all recordings", head, rows, {2, 3})
        )


def _rejections(report: RunReport, folder: Path) -> Iterator[tuple[str, ...]]:
    groups: dict[tuple[str, str], list[tuple[int, int, str]]] = defaultdict(list)
    for at, one in enumerate(report.recordings):
        for topic in one.topics:
            for rejection in topic.rejections:
                said = f"{one.sequence}{topic.target}: {rejection.reason}"
                groups[rejection.stage.value, rejection.rule].append((at, rejection.count, said))
    for (stage, rule), found in sorted(groups.items(), key=lambda group: -sum(one[1] for one in group[1])):
        recordings = {at for at, _, _ in found}
        link = element("a", count_text(len(recordings)), href=f"#r{min(recordings)}")
        messages = count_text(sum(count for _, count, _ in found))
        yield stage, rule, messages, link, found[0][2], _kept(report, recordings, folder)


def _kept(report: RunReport, recordings: set[int], folder: Path) -> Markup:
    """Link the folders that hold messages of these recordings; most runs have one."""
    links = {
        folder_link(report.recordings[at], folder): Path(kept).parent
        for at in sorted(recordings)
        if (kept := report.recordings[at].quarantine)
    }
    return join(*(element("a", str(path), href=link) for link, path in links.items()))


def _manifests(report: RunReport) -> Iterator[Markup]:
    """Yield the manifests the run was made from, closed."""
    if report.manifests:
        yield element("h2", "Manifest" if len(report.manifests) == 1 else "Manifests")
    for used in report.manifests:
        text = element("pre", used.text, tabindex="0", role="region", aria_label=used.path)
        yield element(
            "details", element("summary", element("span", used.path, class_="name")), text, class_="manifest"
        )


def _recordings(report: RunReport, folder: Path) -> Markup:
    if not report.recordings:
        return element("p", "No recording was ingested.", id="recordings")
    words = element("label", "Filter ", element("input", type="search", id="words", autocomplete="off"))
    problems = element("label", element("input", type="checkbox", id="problems"), " only those with problems")
    shown = element("span", id="shown", role="status", class_="dim")
    opened = {at for at, _ in zip(range(len(report.recordings)), range(_OPEN), strict=False)}
    opened |= set(islice((at for at, one in enumerate(report.recordings) if one.status in _BAD), _OPEN))
    return join(
        element("h2", "Recordings", id="recordings"),
        element("div", words, problems, shown, class_="filter", hidden=True),
        *(
            _recording(at, one, _aside(report, one, folder), is_open=at in opened)
            for at, one in enumerate(report.recordings)
        ),
    )


def _aside(report: RunReport, one: Report, folder: Path) -> Markup | None:
    """Say where a recording's rejected messages lie, and how they come in once the reason is mended."""
    link, command = folder_link(one, folder), replay_command(report, one)
    if link is None or one.quarantine is None:
        return None
    count = count_text(sum(topic.quarantined for topic in one.topics))
    file = element("a", one.quarantine, href=link)
    return element(
        "p",
        f"{count} rejected messages lie in ",
        file,
        "; mend the manifest, then ",
        element("code", command),
    )


def _recording(at: int, one: Report, aside: Markup | None, *, is_open: bool) -> Markup:
    totals = one.totals
    summary = element(
        "summary",
        element("span", one.sequence, class_="name"),
        element("span", STATUS_WORDS[one.status], class_=f"state {one.status.value}"),
        element("span", f"{count_text(totals.written)} of {count_text(totals.read)} messages"),
        element("span", f"{count_text(totals.rejected)} rejected", class_="warn")
        if totals.rejected
        else None,
        element("span", seconds_text(one.duration_s), class_="dim"),
    )
    problem = one.status is not RunStatus.COMPLETED and one.status is not RunStatus.SKIPPED
    return element(
        "details",
        summary,
        element("div", *_inside(one, aside), class_="inside"),
        class_="recording",
        id=f"r{at}",
        open=is_open,
        data_words=" ".join((one.sequence, *one.files, *(topic.target for topic in one.topics))),
        data_problem="yes" if problem else None,
    )


def _inside(one: Report, aside: Markup | None) -> Iterator[Markup]:
    if one.error:
        yield element("p", one.error, class_="error")
    rate = one.totals.read / one.duration_s if one.duration_s else 0
    stored = f", {one.compression:.0%} of it stored" if one.compression is not None else ""
    where = f"{', '.join(one.files)} ({bytes_text(one.source_bytes)}{stored}) to {one.destination}"
    yield element("p", f"{where}; {count_text(round(rate))} messages a second", class_="dim")
    yield from (part for part in (steps_line(one.steps), aside) if part is not None)
    taken = [topic for topic in one.topics if topic.status is not TopicStatus.EXCLUDED]
    if taken:
        yield _topics(taken)
    yield from _lists(one)


def _topics(taken: list[TopicReport]) -> Markup:
    times = [time for topic in taken for time in (topic.start_ns, topic.end_ns) if time is not None]
    span = (min(times), max(times)) if times else (0, 0)
    during = f"from {time_text(span[0])} to {time_text(span[1])} UTC" if times else "no rows"
    head = ("Topic", "Ontology", "Read", "Written", "Rejected", "Rate", "Stored", "Rows over time (gaps red)")
    rows = [_topic(topic, span) for topic in sorted(taken, key=lambda topic: topic.target)]
    return table(f"{counted(len(taken), 'topic')}, {during}", head, rows, {2, 3, 4, 5, 6})


def _topic(topic: TopicReport, span: tuple[int, int]) -> tuple[str, ...]:
    rejected = count_text(topic.rejected)
    return (
        topic.target,
        topic.ontology,
        count_text(topic.read),
        count_text(topic.written),
        element("strong", rejected, class_="warn") if topic.rejected else rejected,
        f"{topic.rate_hz:.1f} Hz" if topic.rate_hz is not None else "",
        bytes_text(topic.stored_bytes),
        sparkline(topic, span) or "",
    )


def _lists(one: Report) -> Iterator[Markup]:
    """Yield what there is to say about a recording beside its numbers."""
    rejected = [
        f"{topic.target}: {count_text(r.count)} at {r.stage.value} [{r.rule}]: {r.reason} "
        f"(the first recorded {time_text(r.first_log_time_ns)}, offset {r.first_offset})"
        for topic in one.topics
        for r in topic.rejections
    ]
    lost = [
        f"{item.topic or 'the recording'}: {'?' if item.count is None else count_text(item.count)} messages"
        f"{'' if item.offset is None else f' at offset {item.offset}'}: {item.reason}"
        for item in one.unreadable_ranges
    ]
    kept = [
        f"{topic.target}: {count_text(topic.quarantined)} messages"
        for topic in one.topics
        if topic.quarantined
    ]
    left = [f"{topic.topic}: {topic.why}" for topic in one.topics if topic.status is TopicStatus.EXCLUDED]
    for title, lines in {
        "Rejected": rejected,
        "In the quarantine": kept,
        "Unreadable": lost,
        "Left out": left,
        "Notes": one.findings,
    }.items():
        if lines:
            yield join(element("h3", title), element("ul", *(element("li", line) for line in lines)))


def _link(at: int, one: Report) -> Markup:
    return element("a", one.sequence, href=f"#r{at}")
