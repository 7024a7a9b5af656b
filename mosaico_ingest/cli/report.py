"""`ingest report` and `inspect`, and their tables."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, plain_table
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    counted,
    seconds_text,
    time_text,
)

if TYPE_CHECKING:
    from mosaico_ingest.report.model import Report, RunReport, TopicReport
    from mosaico_ingest.services.inspection import Inspection

__all__ = [
    "inspect",
    "open_console",
    "print_inspection",
    "print_json",
    "print_report",
    "report",
]

COLUMNS = ("read", "written", "rejected", "rate", "payload", "stored")
ROOMY = 100
"""Columns of a terminal that has room for all of them."""
MANY = 3
"""More recordings than that get a line each instead of a table each."""
MOST_REASONS = 20
"""Lines of a batch that say why messages were rejected."""
STATUS_STYLE = {RunStatus.COMPLETED: "green", RunStatus.REJECTED: "yellow", RunStatus.SKIPPED: "dim"}


def open_console() -> Console:
    """Return standard output as wide as it is, or wide enough where it is no terminal."""
    return Terminal()


def print_json(text: str) -> None:
    """Write JSON to standard output as it is."""
    sys.stdout.write(text + "\n")


def print_inspection(found: Inspection, *, as_json: bool) -> None:
    """Print what a recording holds."""
    if as_json:
        print_json(found.model_dump_json(indent=2))
        return
    console = open_console()
    span = ""
    if found.duration_s is not None:
        span = f", {time_text(found.start_ns)} .. {time_text(found.end_ns)} UTC ({seconds_text(found.duration_s)})"
    messages = "? messages" if found.messages is None else counted(found.messages, "message")
    console.print(Text(f"{', '.join(found.files)}", style="bold"))
    console.print(f"{found.container}, {bytes_text(found.size_bytes)}, {messages}{span}", soft_wrap=True)
    names = ("topic", "type", "messages", "rate", "definition", "becomes", "adapter")
    table = plain_table(*names, numbers={"messages", "rate"})
    for topic in found.topics:
        count = "?" if topic.count is None else count_text(topic.count)
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.1f} Hz"
        style = None if topic.ontology else "yellow"
        table.add_row(
            topic.topic,
            topic.msgtype,
            count,
            rate,
            topic.definition,
            topic.ontology or "-",
            topic.adapter,
            style=style,
        )
    console.print(table if found.topics else "no topics")
    for topic in found.topics:
        if topic.problem and not any(topic.problem in finding for finding in found.findings):
            console.print(Text(f"{topic.topic}: {topic.problem}", style="yellow"), soft_wrap=True)
    for finding in found.findings:
        console.print(Text(f"note: {finding}", style="yellow"), soft_wrap=True)


def print_report(report: RunReport) -> None:
    """Print what was done."""
    console = open_console()
    if len(report.recordings) > MANY:
        _print_batch(report, console)
        return
    for recording in report.recordings:
        _print_recording(recording, console)


def _print_batch(report: RunReport, console: Console) -> None:
    """Print a line for each recording, and the sums."""
    table = plain_table("sequence")
    table.add_column("status", no_wrap=True)
    for column in ("topics", "read", "written", "rejected", "stored", "time"):
        table.add_column(column, justify="right", no_wrap=True)
    for one in report.recordings:
        totals, taken = one.totals, sum(t.status is not TopicStatus.EXCLUDED for t in one.topics)
        counts = (taken, totals.read, totals.written, totals.rejected)
        style = STATUS_STYLE.get(one.status, "red")
        table.add_row(
            one.sequence,
            Text(one.status.value, style=style),
            *map(count_text, counts),
            bytes_text(totals.stored_bytes),
            seconds_text(one.duration_s),
        )
    console.print(table)
    reasons = [f"{one.sequence}: {line}" for one in report.recordings for line in _rejections(one)]
    for line in reasons[:MOST_REASONS]:
        console.print(Text(line, style="yellow"), soft_wrap=True)
    if len(reasons) > MOST_REASONS:
        more = counted(len(reasons) - MOST_REASONS, "more reason")
        console.print(Text(f"… and {more}, which --report FILE keeps", style="yellow"), soft_wrap=True)
    style = "green" if report.exit_code in {0, 4} else "red"
    console.print(Text(report.headline, style=style), soft_wrap=True)


def _print_recording(report: Report, console: Console) -> None:
    if report.status is RunStatus.SKIPPED:
        console.print(f"{report.sequence}: skipped, the same content is there already", highlight=False)
    if report.status is RunStatus.SKIPPED or not report.topics:
        return
    if report.status is RunStatus.FAILED and not report.totals.read:
        return  # the error says it all
    columns = COLUMNS if console.width >= ROOMY else tuple(c for c in COLUMNS if c not in {"rate", "payload"})
    table = plain_table("topic")
    table.add_column("ontology", style="cyan", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for topic in report.topics:
        if topic.status is not TopicStatus.EXCLUDED:
            cells = _cells(topic)
            table.add_row(topic.target, topic.ontology, *(cells[column] for column in columns))
    console.print(table)
    _print_excluded(report, console)
    for line in _rejections(report):
        console.print(Text(line, style="yellow"), soft_wrap=True)
    _print_totals(report, console)


def _rejections(report: Report) -> Iterator[str]:
    """Yield how many messages of each topic were rejected, and why."""
    for topic in report.topics:
        for one in topic.rejections:
            yield f"{topic.target}: {count_text(one.count)} rejected [{one.rule}]: {one.reason}"


def _cells(topic: TopicReport) -> dict[str, str | Text]:
    return {
        "read": count_text(topic.read),
        "written": count_text(topic.written),
        "rejected": Text(count_text(topic.rejected), style="red" if topic.rejected else "dim"),
        "rate": "" if topic.rate_hz is None else f"{topic.rate_hz:.1f} Hz",
        "payload": bytes_text(topic.payload_bytes),
        "stored": bytes_text(topic.stored_bytes),
    }


def _print_excluded(report: Report, console: Console) -> None:
    """Print the topics that were not read, those with the same reason together."""
    reasons: dict[str, list[str]] = {}
    for topic in report.topics:
        if topic.status is TopicStatus.EXCLUDED:
            reasons.setdefault(topic.why, []).append(topic.topic)
    for why, topics in reasons.items():
        console.print(Text(f"left out {', '.join(topics)}: {why}", style="dim"), soft_wrap=True)


def _sizes(report: Report) -> str:
    """Compare what is stored with the source where all of it was taken, else with the messages read."""
    stored = report.totals.stored_bytes
    taken = [topic for topic in report.topics if topic.status is not TopicStatus.EXCLUDED]
    promised = sum(topic.promised or 0 for topic in taken)
    partial = len(taken) < len(report.topics) or report.totals.read < promised
    before = report.totals.payload_bytes if partial else report.source_bytes
    what = " of messages" if partial else ""
    change = f", {stored / before:.0%}" if before else ""
    return f"{bytes_text(before)}{what} stored in {bytes_text(stored)}{change}"


def _print_totals(report: Report, console: Console) -> None:
    totals = report.totals
    parts = [f"{count_text(totals.written)} of {count_text(totals.read)} messages written"]
    if totals.rejected:
        parts.append(f"{count_text(totals.rejected)} rejected")
    if report.unreadable_ranges:
        lost = sum(item.count or 0 for item in report.unreadable_ranges)
        parts.append(f"{count_text(lost)} unreadable" if lost else "some unreadable")
    if totals.downsampled:
        parts.append(f"{count_text(totals.downsampled)} sampled away")
    if totals.stored_bytes:
        parts.append(_sizes(report))
    rate = totals.read / report.duration_s if report.duration_s else 0
    parts.append(f"{seconds_text(report.duration_s)}, {count_text(round(rate))} msg/s")
    style = STATUS_STYLE.get(report.status, "red")
    console.print(
        Text(f"{report.sequence} in {report.destination}: {', '.join(parts)}", style=style), soft_wrap=True
    )


def inspect(
    path: Annotated[
        str, typer.Argument(metavar="BAG", help="A recording: a file, a rosbag2 directory, or a URL.")
    ],
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="As ros2_humble; for recordings without definitions.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List topics, types, counts, rates, time span, definitions and the adapter each topic would get."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_as_usual, forgo_pandas

    collect_as_usual()
    forgo_pandas()
    print_inspection(api.inspect_recording(path, ros_distro=ros_distro), as_json=as_json)


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="RUN.json", help="What `ingest run --report RUN.json` wrote; several add up."),
    ],
    *,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write one page that needs nothing else.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", metavar="FILE", help="Write a summary for a CI job's page.")
    ] = None,
) -> None:
    """Show a report: as tables here, as a page, as Markdown."""
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.report.html import html_page
    from mosaico_ingest.report.markdown import markdown_summary
    from mosaico_ingest.report.model import read_report
    from mosaico_ingest.textfile import write_whole

    parts = [read_report(path) for path in paths]
    found = parts[0].model_copy(
        update={
            "manifests": tuple(dict.fromkeys(one for part in parts for one in part.manifests)),
            "recordings": tuple(one for part in parts for one in part.recordings),
        }
    )
    if html is not None:
        write_whole(html, html_page(found, html.parent))
        typer.echo(f"wrote {html}", err=True)
    if markdown is not None:
        write_whole(markdown, markdown_summary(found))
        typer.echo(f"wrote {markdown}", err=True)
    if html is None and markdown is None:
        print_report(found)
        for one in found.recordings:
            if one.error is not None:
                print_line(f"error: {one.error}")
