"""`ingest export`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.options import (
    DEFAULT_STORE,
    STANDARD_OUTPUT,
    STORE,
    ApiKeyOption,
    ForceOption,
    JsonOption,
    TlsCertOption,
    TopicsOption,
)

if TYPE_CHECKING:
    from mosaico_ingest.export import ExportReport, TopicExport
    from mosaico_ingest.export.sources import SourceSequence

INCOMPLETE = 4
"""Exit code if a topic was excluded, or if ingesting the file would not give the same rows."""


def export(
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="The sequence to export.")],
    *,
    to: Annotated[
        Path,
        typer.Option(
            "--to",
            help="The recording to write: .mcap, .db3 (ROS 2) or .bag (ROS 1); - writes MCAP to standard output.",
            metavar="FILE",
        ),
    ],
    server: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="ADDRESS",
            help="Mosaico server to read from, instead of the store: HOST:PORT, mosaico://HOST:PORT or, with TLS, "
            "mosaico+tls://HOST:PORT.",
        ),
    ] = None,
    api_key: ApiKeyOption = None,
    tls_cert: TlsCertOption = None,
    store: Annotated[str | None, STORE] = None,
    topics: TopicsOption = None,
    start: Annotated[
        str | None,
        typer.Option("--start", help="First instant, or +10s after the first message.", metavar="TIME"),
    ] = None,
    end: Annotated[
        str | None,
        typer.Option(
            "--end", help="End, exclusive: an instant, or -10s before the last message.", metavar="TIME"
        ),
    ] = None,
    adapter: Annotated[
        list[str] | None,
        typer.Option("--adapter", help="Custom adapter that created the rows. Repeatable.", metavar="REF"),
    ] = None,
    ros_distro: Annotated[
        str | None,
        typer.Option(
            "--ros-distro",
            metavar="DISTRO",
            help="Distro of the definitions for topics that were stored without one, such as ros2_humble.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Export a sequence as a recording with the original message definitions.

    Exit codes: 0 complete, 4 a topic was excluded or would not give the same rows if the file were ingested.
    """
    from mosaico_ingest.export import export_sequence

    if server is not None and store is not None:
        raise typer.BadParameter("excludes --from", param_hint="--store")
    with _opened(sequence, server, api_key, tls_cert, store) as source, _written(to) as path:
        report = export_sequence(
            source,
            sequence,
            path,
            topics=topics or (),
            start_ns=_instant_ns("--start", start, source),
            end_ns=_instant_ns("--end", end, source),
            adapters=adapter or (),
            ros_distro=ros_distro,
            replace=force,
        )
    is_piped = to == STANDARD_OUTPUT
    if is_piped:
        report = report.model_copy(update={"path": str(to)})
    if as_json:
        typer.echo(report.model_dump_json(indent=2), err=is_piped)
    else:
        _print_export(report, stderr=is_piped)
    if not report.faithful:
        raise typer.Exit(INCOMPLETE)


@contextmanager
def _written(to: Path) -> Generator[Path, None, None]:
    """Yield the path to write; for standard output that of a temporary file, whose content follows at the end."""
    if to != STANDARD_OUTPUT:
        yield to
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "export.mcap"
        yield path
        with path.open("rb") as file:
            shutil.copyfileobj(file, sys.stdout.buffer)
        sys.stdout.buffer.flush()


@contextmanager
def _opened(
    sequence: str, server: str | None, api_key: str | None, tls_cert: Path | None, store: str | None
) -> Generator[SourceSequence, None, None]:
    """Open a sequence of a server or of a store."""
    from mosaico_ingest.export.sources import ServerSequence, StoreSequence

    if server is None:
        from mosaico_ingest.destinations.store import Store

        yield StoreSequence(Store.open(store or DEFAULT_STORE, create=False), sequence)
        return
    from mosaico_ingest.destinations.server.client import connect, server_at

    with connect(server_at(server, api_key=api_key, tls_cert=tls_cert)) as client:
        yield ServerSequence(client, sequence)


def _instant_ns(option: str, text: str | None, source: SourceSequence) -> int | None:
    """Return ns since the epoch; `+` counts from the first message, `-` back from the last."""
    from mosaico_ingest.job.values import parse_instant, parse_offset

    if text is None:
        return None
    try:
        if not text.startswith(("+", "-")):
            return parse_instant(text)
        offset_ns = parse_offset(text)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint=option) from None
    return source.bounds[offset_ns < 0] + offset_ns


def _print_export(report: ExportReport, *, stderr: bool) -> None:
    from mosaico_ingest.cli.console import PlainTable, Terminal, print_line
    from mosaico_ingest.report.units import bytes_text, count_text, counted

    table = PlainTable("topic", "type", "adapter", "messages", numbers={"messages"})
    for topic in report.topics:
        if not topic.excluded:
            table.add_row(topic.topic, topic.msgtype, topic.adapter, count_text(topic.messages))
    Terminal(stderr=stderr).print(table)
    for topic in report.topics:
        for difference in _differences(topic):
            print_line(f"{topic.topic}: {difference}", style="yellow", stderr=stderr)
    for line in report.omitted:
        print_line(f"not in the file: {line}", style="yellow", stderr=stderr)
    warning = "" if report.faithful else "; some content would be missing or differ if the file were ingested"
    line = f"{report.path}: {counted(report.messages, 'message')}, {bytes_text(report.bytes)}{warning}"
    print_line(line, style="green" if report.faithful else "yellow", stderr=stderr)


def _differences(topic: TopicExport) -> list[str]:
    """Return how the exported messages differ from the original ones."""
    lines = [f"excluded: {topic.exclusion}"] if topic.excluded else []
    if topic.assumed:
        lines.append(f"stored without a definition; {topic.assumed} is assumed")
    lines += [f"{column} cannot be inverted ({reason})" for column, reason in topic.not_invertible.items()]
    if topic.defaulted:
        lines.append(f"not in the store, so absent, zero or empty: {', '.join(topic.defaulted)}")
    lines += [
        f"{column} would differ in {count:,} messages after ingestion"
        for column, count in topic.changed.items()
    ]
    return lines
