"""`ingest export` and `view`: stored sequences as recordings, in the Rerun viewer, or in Foxglove."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.console import PlainTable, Terminal, print_line
from mosaico_ingest.cli.options import (
    DEFAULT_STORE,
    STANDARD_OUTPUT,
    STORE,
    ApiKeyOption,
    ForceOption,
    JsonOption,
    StoreOption,
    TlsCertOption,
    TopicsOption,
)
from mosaico_ingest.display import bytes_text, count_text, counted

if TYPE_CHECKING:
    from mosaico_ingest.destinations.store import SequenceInfo, Store
    from mosaico_ingest.export import ExportReport, TopicExport
    from mosaico_ingest.export.sources import SourceSequence
    from mosaico_ingest.view.rerun_recording import ViewedTopic

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


def view(
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="The sequence to show.")],
    *,
    topics: TopicsOption = None,
    start: Annotated[
        str | None,
        typer.Option("--from", metavar="TIME", help="Start here: a time, or an offset such as +10s."),
    ] = None,
    end: Annotated[
        str | None,
        typer.Option("--until", metavar="TIME", help="End here: a time, or an offset such as +20s."),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="FILE.rrd", help="Write a Rerun file instead of opening the viewer."),
    ] = None,
    foxglove: Annotated[
        Path | None,
        typer.Option("--foxglove", metavar="FILE.mcap", help="Write an MCAP file for Foxglove instead."),
    ] = None,
    force: ForceOption = False,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Show a sequence in the Rerun viewer: images, point clouds, transforms, map, plots and logs."""
    from mosaico_ingest.cli.store_rows import time_option
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.view.rerun_recording import send_sequence

    if save is not None and foxglove is not None:
        raise typer.BadParameter("excludes --save", param_hint="--foxglove")
    target = save or foxglove
    if target is not None and target.exists() and not force:
        raise typer.BadParameter(
            f"{target} exists; replace it with --force", param_hint="--save" if save else "--foxglove"
        )
    opened = Store.open(store, create=False)
    info = _selected(opened.sequence(sequence), topics)
    start_ns = None if start is None else time_option(info, start, option="--from")
    end_ns = None if end is None else time_option(info, end, option="--until")
    if foxglove is not None:
        _write_foxglove(opened, info, foxglove, start_ns, end_ns)
        return
    _print_viewed(send_sequence(info, save=save, start_ns=start_ns, end_ns=end_ns))
    if save is not None:
        print_line(f"wrote {save}: {bytes_text(save.stat().st_size)}; open it with `rerun {save}`")


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


def _selected(info: SequenceInfo, topics: list[str] | None) -> SequenceInfo:
    """Return the sequence with the topics that the globs select."""
    from msgspec.structs import replace

    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.job.values import select

    if not topics:
        return info
    names = set(select(topics, [topic.name for topic in info.topics]).selected)
    matches = tuple(topic for topic in info.topics if topic.name in names)
    if not matches:
        raise NothingMatched(f"no topic matches {', '.join(topics)}", where=info.name)
    return replace(info, topics=matches)


def _write_foxglove(
    store: Store, info: SequenceInfo, path: Path, start_ns: int | None, end_ns: int | None
) -> None:
    """Write the topics that can be restored as messages of ROS, which Foxglove shows without extensions."""
    from mosaico_ingest.export import export_sequence

    names = [topic.name for topic in info.topics]
    report = export_sequence(
        store, info.name, path, topics=names, start_ns=start_ns, end_ns=end_ns, replace=True
    )
    for topic in report.topics:
        if topic.excluded:
            print_line(f"{topic.topic}: not shown: {topic.excluded}", style="yellow", stderr=True)
    size = bytes_text(path.stat().st_size)
    print_line(f"wrote {path}: {counted(report.messages, 'message')}, {size}; open it in Foxglove")


def _print_viewed(viewed: list[ViewedTopic]) -> None:
    table = PlainTable("topic", "ontology", "shown as")
    for each in viewed:
        table.add_row(each.path, each.topic.ontology.tag, ", ".join(each.kinds) or "-")
    Terminal().print(table)
    for each in viewed:
        for problem, count in each.problems.items():
            print_line(
                f"{each.path}: {counted(count, 'row')} not shown: {problem}", style="yellow", stderr=True
            )
