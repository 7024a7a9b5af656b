"""The page of a run: verdict and problems, contract results, changes, and every recording with its topics over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup
from msgspec import Struct

from mosaico_ingest.pages.design import macro, pack, render
from mosaico_ingest.pages.problems import run_problems
from mosaico_ingest.pages.recording import (
    FAILED,
    RecordingView,
    StepShare,
    contract_summaries,
    step_shares,
)
from mosaico_ingest.report.collect import slowest, step_seconds
from mosaico_ingest.report.compare import Comparison
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.files import RunReport
from mosaico_ingest.report.model import Report
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    counted,
    percent_text,
    seconds_text,
    unreadable_text,
)

MAX_OPEN = 10
"""Recordings with problems that are expanded when the page opens, and whose content is not packed."""
MAX_ROWS = 50
"""Recordings above which the list is packed, except for its start."""
PACK_SIZE = 25
"""Recordings whose content is packed together."""
MAX_SLOWEST = 10
MAX_RESULTS = 200
"""Expectations that the table lists; failed ones come first."""


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
