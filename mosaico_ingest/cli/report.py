"""`ingest report` and `inspect`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal, print_line
from mosaico_ingest.cli.options import DistroOption, JsonOption, RecordingArgument, write_output
from mosaico_ingest.display import (
    bytes_text,
    count_text,
    counted,
    rate_text,
    seconds_text,
    stored_text,
    time_text,
    written_cell,
)
from mosaico_ingest.findings import Stage, join_names
from mosaico_ingest.report.events import SUCCESSFUL, RunStatus, TopicStatus

if TYPE_CHECKING:
    from mosaico_ingest.report.recording import Report, TopicReport
    from mosaico_ingest.report.run import RunReport
    from mosaico_ingest.report.summaries import Comparison
    from mosaico_ingest.services.inspection import Inspection

WIDE = 100
"""Terminal columns from which all columns of a report's table fit."""
MAX_TABLES = 3
"""Recordings above which each gets one row in a common table instead of a table of its topics."""
MAX_ROWS = 200
"""Recordings that the common table lists; those with problems come first if there are more."""
MAX_NAMED_TOPICS = 3
"""Topics above which a reason of rejections names their number instead."""
MAX_REASONS = 20
"""Reasons of rejections printed for a batch."""
STATUS_STYLES = {
    RunStatus.COMPLETED: "green",
    RunStatus.WITH_ERRORS: "yellow",
    RunStatus.DIVERTED: "red",
    RunStatus.SKIPPED: "dim",
    RunStatus.FAILED: "red",
    RunStatus.INTERRUPTED: "red",
}


def inspect(path: RecordingArgument, ros_distro: DistroOption = None, as_json: JsonOption = False) -> None:
    """List a recording's topics with type, count, rate, definition and adapter, without reading messages."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas

    collect_garbage_as_usual()
    hide_pandas()
    inspection = api.inspect_recording(path, ros_distro=ros_distro)
    if as_json:
        typer.echo(inspection.model_dump_json(indent=2))
    else:
        print_inspection(inspection)


def print_inspection(inspection: Inspection) -> None:
    """Print the files, the topics and the findings of a recording."""
    span = ""
    if inspection.duration_s is not None:
        start, end = time_text(inspection.start_ns), time_text(inspection.end_ns)
        span = f", {start} .. {end} UTC ({seconds_text(inspection.duration_s)})"
    messages = "? messages" if inspection.messages is None else counted(inspection.messages, "message")
    print_line(", ".join(inspection.files), style="bold")
    print_line(f"{inspection.container}, {bytes_text(inspection.size_bytes)}, {messages}{span}")
    names = ("topic", "type", "messages", "rate", "definition", "becomes", "adapter")
    table = PlainTable(*names, numbers={"messages", "rate"})
    for topic in inspection.topics:
        table.add_row(
            topic.topic,
            topic.msgtype,
            "?" if topic.count is None else count_text(topic.count),
            rate_text(topic.rate_hz),
            topic.definition,
            topic.ontology or "-",
            topic.adapter,
            style=None if topic.ontology else "yellow",
        )
    Terminal().print(table if inspection.topics else "no topics")
    for topic in inspection.topics:
        if topic.problem and not any(topic.problem in finding for finding in inspection.findings):
            print_line(f"{topic.topic}: {topic.problem}", style="yellow")
    for finding in inspection.findings:
        print_line(f"note: {finding}", style="yellow")


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN.json", help="Report files of `ingest run --report`; several are combined."
        ),
    ],
    *,
    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="Write a self-contained page; - writes it to stdout."),
    ] = None,
    markdown: Annotated[
        Path | None,
        typer.Option(
            "--markdown", metavar="FILE", help="Write a summary for a CI job; - writes it to stdout."
        ),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="LAST.json",
            help="Report of an earlier run; the changes since then are listed.",
        ),
    ] = None,
) -> None:
    """Show report files as tables, as an HTML page, or as a Markdown summary."""
    from mosaico_ingest.cli.process import collect_garbage_as_usual
    from mosaico_ingest.pages.run import run_page
    from mosaico_ingest.report.run import combine, read_report
    from mosaico_ingest.report.summaries import compare_reports, markdown_summary

    collect_garbage_as_usual()
    reports = [read_report(path) for path in paths]
    combined = combine(reports)
    comparison = compare_reports(combined, read_report(compare)) if compare is not None else None
    if html is not None:
        write_output(html, run_page(combined, html.parent, comparison), announce=True)
    if markdown is not None:
        write_output(markdown, markdown_summary(combined, comparison), announce=True)
    if html is None and markdown is None:
        print_report(combined)
        for recording in combined.recordings:
            if recording.error is not None:
                print_line(f"error: {recording.error}")
        if comparison is not None:
            print_comparison(comparison)


def print_comparison(comparison: Comparison) -> None:
    """Print a row for each change since an earlier run."""
    names = ("recording", "topic", "property", "before", "now", "change")
    table = PlainTable(*names, numbers={"before", "now", "change"})
    for change in comparison.changes:
        percent = "" if change.ratio is None else f"{(change.ratio - 1) * 100:+.0f} %"
        table.add_row(change.recording, change.topic, change.aspect, change.before, change.after, percent)
    if comparison.changes:
        Terminal().print(table)
    print_line(comparison.headline)


def print_report(report: RunReport, *, stderr: bool = False) -> None:
    """Print a table of topics for each recording, or a table of recordings if there are many."""
    if len(report.recordings) > MAX_TABLES:
        _print_batch(report, stderr=stderr)
        return
    for recording in report.recordings:
        _print_recording(recording, stderr=stderr)


def _print_batch(report: RunReport, *, stderr: bool) -> None:
    names = ("sequence", "status", "topics", "read", "written", "rejected", "stored", "time")
    table = PlainTable(*names, numbers=set(names[1:]))
    table.columns[1].justify = "left"
    problems: list[Report] = []
    others: list[Report] = []
    reasons: list[str] = []
    reason_count = 0
    for recording in report.recordings:
        group = others if recording.exit_code == 0 else problems
        if len(group) < MAX_ROWS:
            group.append(recording)
        for reason in rejection_lines(recording):
            reason_count += 1
            if reason_count <= MAX_REASONS:
                reasons.append(f"{recording.sequence}: {reason}")
    is_complete = len(report.recordings) <= MAX_ROWS
    for recording in report.recordings if is_complete else (problems + others)[:MAX_ROWS]:
        totals = recording.totals
        table.add_row(
            recording.sequence,
            Text(recording.status.value, style=STATUS_STYLES[recording.status]),
            count_text(sum(topic.status is not TopicStatus.EXCLUDED for topic in recording.topics)),
            count_text(totals.read),
            count_text(totals.written),
            count_text(totals.rejected),
            bytes_text(totals.stored_bytes),
            seconds_text(recording.duration_s),
        )
    Terminal(stderr=stderr).print(table)
    if not is_complete:
        more = counted(len(report.recordings) - MAX_ROWS, "more recording")
        print_line(f"… and {more}; --report FILE writes all of them", stderr=stderr)
    for reason in reasons:
        print_line(reason, style="yellow", stderr=stderr)
    if reason_count > MAX_REASONS:
        more = counted(reason_count - MAX_REASONS, "more reason")
        print_line(f"… and {more}; --report FILE writes all of them", style="yellow", stderr=stderr)
    print_line(report.headline, style="green" if report.exit_code in SUCCESSFUL else "red", stderr=stderr)


def _print_recording(report: Report, *, stderr: bool) -> None:
    if report.status is RunStatus.SKIPPED:
        print_line(f"{report.sequence}: skipped, it already has the same content", stderr=stderr)
        return
    if not report.topics or (report.status is RunStatus.FAILED and not report.totals.read):
        return  # the error that follows is sufficient
    console = Terminal(stderr=stderr)
    names = ("topic", "ontology", "read", "written", "rejected", "rate", "payload", "stored")
    if console.width < WIDE:
        names = tuple(name for name in names if name not in {"rate", "payload"})
    table = PlainTable(*names, numbers=set(names[2:]))
    for topic in report.topics:
        if topic.status is not TopicStatus.EXCLUDED:
            cells = _topic_cells(topic)
            table.add_row(*(cells[name] for name in names))
    console.print(table)
    _print_excluded(report, stderr=stderr)
    for reason in rejection_lines(report):
        print_line(reason, style="yellow", stderr=stderr)
    line = f"{report.sequence} in {report.destination}: {', '.join(_totals(report))}"
    print_line(line, style=STATUS_STYLES[report.status], stderr=stderr)


def _topic_cells(topic: TopicReport) -> dict[str, str | Text]:
    return {
        "topic": topic.target,
        "ontology": topic.ontology,
        "read": count_text(topic.read),
        "written": written_cell(topic.written, topic.rows),
        "rejected": Text(count_text(topic.rejected), style="red" if topic.rejected else "dim"),
        "rate": rate_text(topic.rate_hz),
        "payload": bytes_text(topic.payload_bytes),
        "stored": bytes_text(topic.stored_bytes),
    }


def _print_excluded(report: Report, *, stderr: bool) -> None:
    """Print the excluded topics, one line for each reason."""
    reasons: dict[str, list[str]] = {}
    for topic in report.topics:
        if topic.status is TopicStatus.EXCLUDED:
            reasons.setdefault(topic.why, []).append(topic.topic)
    for reason, topics in reasons.items():
        print_line(
            f"{counted(len(topics), 'topic')} {reason}: {join_names(topics)}", style="dim", stderr=stderr
        )


def rejection_lines(report: Report) -> Iterator[str]:
    """Yield a line for each reason of rejected messages, with its topics."""
    counts: dict[tuple[str, str], dict[str, int]] = {}
    for topic in report.topics:
        for rejection in topic.rejections:
            if topic.shares_messages and rejection.stage is not Stage.WRITE:
                continue  # the other topic counts the same message
            by_topic = counts.setdefault((rejection.rule, rejection.reason), {})
            by_topic[topic.target] = by_topic.get(topic.target, 0) + rejection.count
    for (rule, reason), by_topic in counts.items():
        topics = ", ".join(by_topic) if len(by_topic) <= MAX_NAMED_TOPICS else f"{len(by_topic)} topics"
        yield f"{topics}: {count_text(sum(by_topic.values()))} rejected [{rule}]: {reason}"


def _totals(report: Report) -> Iterator[str]:
    totals = report.totals
    yield report.written_text
    if totals.rejected:
        yield f"{count_text(totals.rejected)} rejected"
    if report.unreadable_ranges:
        unreadable = sum(item.count or 0 for item in report.unreadable_ranges)
        yield f"{count_text(unreadable)} unreadable" if unreadable else "some unreadable"
    if totals.downsampled:
        yield f"{count_text(totals.downsampled)} downsampled"
    if totals.stored_bytes:
        # Only a complete recording can be compared with the size of its files.
        is_part = any(topic.status is TopicStatus.EXCLUDED for topic in report.topics) or totals.read < sum(
            topic.promised or 0 for topic in report.counted_topics
        )
        size = totals.payload_bytes if is_part else report.source_bytes
        yield stored_text(size, totals.stored_bytes, of=" of messages" if is_part else "")
    rate = totals.read / report.duration_s if report.duration_s else 0
    yield f"{seconds_text(report.duration_s)}, {count_text(round(rate))} msg/s"
