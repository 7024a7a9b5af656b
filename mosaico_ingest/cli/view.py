"""`ingest view`: a sequence in the Rerun viewer or in Foxglove."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.console import PlainTable, Terminal, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, ForceOption, StoreOption, TopicsOption
from mosaico_ingest.report.units import bytes_text, counted

if TYPE_CHECKING:
    from mosaico_ingest.destinations.store import SequenceInfo, Store
    from mosaico_ingest.view.rerun_recording import ViewedTopic


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
