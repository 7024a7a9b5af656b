"""This file is `ingest export`: a stored sequence back as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mosaico_ingest.export import ExportReport, TopicExport

__all__ = ["export"]

NOT_ALL = 4
"""The exit code where something was left out, or would not come out the same."""


def export(
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="The sequence to write.")],
    *,
    to: Annotated[
        Path,
        typer.Option("--to", help="The recording: .mcap, .db3 (ROS 2) or .bag (ROS 1).", metavar="FILE"),
    ],
    store: Annotated[
        str, typer.Option("--store", help="The store's folder or URL.", metavar="DIR|URL")
    ] = "mosaico",
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", "-t", help="Topic or glob; a leading ! leaves out. Repeatable."),
    ] = None,
    start: Annotated[
        str | None, typer.Option("--start", help="Instant, or +10s after the first message.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--end", help="Instant, or -10s before the last message; not included.")
    ] = None,
    adapter: Annotated[
        list[str] | None,
        typer.Option(
            "--adapter", help="An adapter of your own that made the rows. Repeatable.", metavar="REF"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace the file if it is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Write a sequence back as a recording, with its messages' own definitions.

    Exits with 4 where a topic was left out, or would not give the same rows if the file were ingested.
    """
    from mosaico_ingest.cli.report import print_json
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.export import export_sequence

    opened = Store.open(store, create=False)
    info = opened.sequence(sequence)
    report = export_sequence(
        opened,
        sequence,
        to,
        topics=topics or (),
        start_ns=_instant("--start", start, info.start_ns, info.end_ns),
        end_ns=_instant("--end", end, info.start_ns, info.end_ns),
        adapters=adapter or (),
        replace=force,
    )
    if as_json:
        print_json(report.model_dump_json(indent=2))
    else:
        _print(report)
    if not report.faithful:
        raise typer.Exit(NOT_ALL)


def _instant(option: str, text: str | None, first_ns: int | None, last_ns: int | None) -> int | None:
    """Return ns since the epoch; an offset counts from the first message, a negative one from the last."""
    from mosaico_ingest.job.units import parse_instant, parse_offset

    if text is None:
        return None
    try:
        if not text.startswith(("+", "-")):
            return parse_instant(text)
        offset = parse_offset(text)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from None
    return ((last_ns if offset < 0 else first_ns) or 0) + offset


def _print(report: ExportReport) -> None:
    from rich.text import Text

    from mosaico_ingest.cli.console import plain_table
    from mosaico_ingest.cli.report import open_console
    from mosaico_ingest.report.units import bytes_text, count_text

    console = open_console()
    table = plain_table("topic", "type", "adapter", "messages", numbers={"messages"})
    for topic in report.topics:
        if not topic.excluded:
            table.add_row(topic.topic, topic.msgtype, topic.adapter, count_text(topic.messages))
    console.print(table)
    for topic in report.topics:
        for line in _remarks(topic):
            console.print(Text(f"{topic.topic}: {line}", style="yellow"), soft_wrap=True)
    said = "" if report.faithful else "; not all of it would come out the same if it were ingested"
    line = f"{report.path}: {count_text(report.messages)} messages, {bytes_text(report.bytes)}{said}"
    console.print(Text(line, style="green" if report.faithful else "yellow"), soft_wrap=True)


def _remarks(topic: TopicExport) -> list[str]:
    """Say in words what the messages lack."""
    lines = [f"left out: {topic.excluded}"] if topic.excluded else []
    lines += [f"{column} cannot be undone ({how})" for column, how in topic.not_undone.items()]
    if topic.unknown:
        lines.append(f"not in the store, written as zero or empty: {', '.join(topic.unknown)}")
    lines += [
        f"{column} would come out otherwise in {count:,} messages" for column, count in topic.changed.items()
    ]
    return lines
