"""`ingest store`: list, show, remove and compact sequences; also `verify`."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mosaico_ingest.cli.console import PlainTable, Terminal, print_json, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, JsonOption, StoreOption, write_output
from mosaico_ingest.cli.store_rows import describe, head, image, plot, sample, sql, tail
from mosaico_ingest.display import bytes_text, count_text, counted, seconds_text, time_text
from mosaico_ingest.job.values import ATTACHMENTS_KEY, PROVENANCE_KEY, Compression

if TYPE_CHECKING:
    import pyarrow as pa

    from mosaico_ingest.destinations.store import Listing, SequenceInfo, SequenceSummary, TopicInfo
    from mosaico_ingest.destinations.store.model import AttachmentInfo

DEFAULT_ROWS = 100
"""Number of sequences that `ingest store ls` prints by default."""
CELL_WIDTH = 28
"""Characters of a value in a table of rows."""
METADATA_WIDTH = 100
"""Characters of a metadata value."""
store_app = typer.Typer(no_args_is_help=True, help="List, show, query and remove the sequences of a store.")


def verify(
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="Sequences to verify; all if omitted.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Read stored sequences and compare every page and all rows with their checksums.

    Exit codes: 0 all sequences are complete and intact, 5 a file is damaged or a sequence incomplete.
    """
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.destinations.store.store import verify as verify_sequence
    from mosaico_ingest.destinations.store.store import verify_attachments
    from mosaico_ingest.errors import VerificationError

    collect_garbage_as_usual()
    hide_pandas()
    opened = Store.open(store, create=False)
    infos = [opened.sequence(name) for name in sequences] if sequences else opened.sequences()
    results = {info.name: list(verify_sequence(info)) for info in infos}
    problems = [
        {"sequence": name, "topic": result.topic, "file": str(result.segment.path), "problem": result.problem}
        for name, checked in results.items()
        for result in checked
        if result.problem is not None
    ]
    problems += [
        {"sequence": info.name, "topic": "", "file": str(each.attachment.path), "problem": each.problem}
        for info in infos
        for each in verify_attachments(info)
        if each.problem is not None
    ]
    incomplete = {info.name: info.incomplete for info in infos if info.incomplete is not None}
    rows = sum(result.segment.rows for checked in results.values() for result in checked)
    size = sum(result.segment.stored_bytes for checked in results.values() for result in checked)
    if as_json:
        values = {"sequences": list(results), "rows": rows, "bytes": size}
        print_json({**values, "problems": problems, "incomplete": incomplete})
    else:
        for problem in problems:
            location = f"{problem['sequence']}{problem['topic']}: {problem['file']}"
            print_line(f"{location}: {problem['problem']}", stderr=True)
        for name, reason in incomplete.items():
            print_line(f"{name}: incomplete: {reason}", stderr=True)
    if problems or incomplete:
        counts = [f"damaged: {counted(len(problems), 'file')}"] if problems else []
        counts += [f"incomplete: {counted(len(incomplete), 'sequence')}"] if incomplete else []
        raise VerificationError(
            ", ".join(counts), where=store, hint="ingest their recordings again with if_exists: replace"
        )
    if not as_json:
        total = f"{counted(len(results), 'sequence')}, {counted(rows, 'row')} in {bytes_text(size)}"
        print_line(f"{total}: all complete and intact")


def list_sequences(
    match: Annotated[
        str | None,
        typer.Argument(metavar="GLOB", help="List only sequences whose names match, such as 'yard_*'."),
    ] = None,
    *,
    metadata: Annotated[
        list[str] | None,
        typer.Option(
            "--metadata",
            "-m",
            metavar="KEY=VALUE",
            help="List only sequences with this metadata; vehicle.id is the key id inside vehicle. Repeatable.",
        ),
    ] = None,
    incomplete: Annotated[bool, typer.Option("--incomplete", help="List only incomplete sequences.")] = False,
    limit: Annotated[
        int | None,
        typer.Option(
            "--limit",
            "-n",
            min=0,
            metavar="N",
            help="Maximum number of sequences; 0 lists all.",
            show_default=f"{DEFAULT_ROWS}; all with --json",
        ),
    ] = None,
    after: Annotated[
        str | None, typer.Option("--after", metavar="NAME", help="Start after the sequence of this name.")
    ] = None,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """List the sequences with their topics, rows, size and time span, sorted by name."""
    from mosaico_ingest.destinations.store import Store

    if limit is None and not as_json:
        limit = DEFAULT_ROWS
    listing = Store.open(store, create=False).listing(
        match=match,
        metadata=_metadata_filter(metadata or ()),
        incomplete=incomplete,
        after=after,
        limit=limit or None,
    )
    if as_json:
        print_json([_summary_json(summary) for summary in listing.sequences])
    else:
        print_sequences(listing)


def show(
    path: Annotated[
        str, typer.Argument(metavar="SEQUENCE[/TOPIC]", help="A sequence, or one of its topics.")
    ],
    store: StoreOption = DEFAULT_STORE,
    rows: Annotated[
        int, typer.Option("--rows", min=0, metavar="N", help="Number of a topic's first rows to print.")
    ] = 3,
    as_json: JsonOption = False,
) -> None:
    """Show a sequence's topics, or a topic's schema, counts, time span, metadata and first rows."""
    from mosaico_ingest.destinations.store import SequenceSummary, Store
    from mosaico_ingest.view.rows import first_rows as first
    from mosaico_ingest.view.texts import json_value

    opened = Store.open(store, create=False)
    sequence, _, topic = path.lstrip("/").partition("/")
    if not topic:
        info = opened.sequence(sequence)
        if as_json:
            print_json(
                {
                    **_summary_json(SequenceSummary.of(info)),
                    "topics": [_topic_json(topic) for topic in info.topics],
                    "attachments": [attachment_json(each) for each in info.attachments],
                }
            )
        else:
            print_sequence(info)
        return
    topic_info = opened.topic(sequence, topic)
    first_rows = first(topic_info, rows).to_pylist()
    if as_json:
        print_json({**_topic_json(topic_info), "first_rows": json_value(first_rows)})
    else:
        print_topic(topic_info, first_rows)


def gc(store: StoreOption = DEFAULT_STORE) -> None:
    """Remove the files of interrupted runs. Committed sequences and active runs are not affected."""
    from mosaico_ingest.destinations.store import Store

    garbage = Store.open(store, create=False).collect_garbage()
    counts = f"{counted(garbage.sessions, 'abandoned session')} and {counted(garbage.files, 'file')}"
    print_line(f"removed {counts}, {bytes_text(garbage.stored_bytes)}")


def remove(
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="The sequence to remove.")],
    store: StoreOption = DEFAULT_STORE,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
) -> None:
    """Remove a sequence and its files."""
    from mosaico_ingest.destinations.store import Store

    opened = Store.open(store, create=False)
    info = opened.sequence(sequence)
    size = f"{counted(info.rows, 'row')}, {bytes_text(info.stored_bytes)}"
    if not yes:
        typer.confirm(f"remove {sequence} ({size}) from {store}?", abort=True)
    opened.delete_sequence(sequence)
    print_line(f"removed {sequence} ({size})")


def page(
    sequence: Annotated[str, typer.Argument(metavar="SEQUENCE", help="The sequence to show.")],
    store: StoreOption = DEFAULT_STORE,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write; - writes to stdout.",
            show_default="SEQUENCE.html",
        ),
    ] = None,
) -> None:
    """Write a self-contained HTML page of a sequence: pictures, tracks, plots, schema, logs and provenance."""
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.pages.sequence import sequence_page

    collect_garbage_as_usual()
    hide_pandas()
    html = sequence_page(Store.open(store, create=False), sequence)
    write_output(out or Path(f"{sequence}.html"), html, announce=True)


def print_sequences(listing: Listing) -> None:
    """Print a row for each sequence, the latest note of each sequence that has notes, and how to continue."""
    if not listing.sequences:
        print_line("no sequences")
        return
    names = ("sequence", "topics", "rows", "size", "start", "duration")
    table = PlainTable(*names, numbers={"topics", "rows", "size", "duration"})
    for summary in listing.sequences:
        table.add_row(
            summary.name,
            count_text(summary.topics),
            count_text(summary.rows),
            bytes_text(summary.stored_bytes),
            time_text(summary.start_ns),
            _duration_text(summary),
        )
    Terminal().print(table)
    for summary in listing.sequences:
        if summary.incomplete is not None:
            print_line(f"{summary.name}: incomplete: {summary.incomplete}", style="red")
        elif summary.notes:  # `store show` prints all of them
            print_line(f"{summary.name}: {summary.notes[-1].message}", style="yellow")
    if listing.next_after is not None:
        position = f"{count_text(len(listing.sequences))} of {counted(listing.total, 'sequence')}"
        print_line(
            f"{position}; continue with --after {shlex.quote(listing.next_after)}, or list all with --limit 0"
        )


def print_sequence(info: SequenceInfo) -> None:
    """Print a sequence's metadata, topics and notes."""
    print_line(info.name, style="bold")
    _print_metadata(info.metadata)
    names = ("topic", "ontology", "rows", "size", "start", "duration")
    table = PlainTable(*names, numbers={"rows", "size", "duration"})
    for topic in info.topics:
        table.add_row(
            topic.name,
            topic.ontology.tag,
            count_text(topic.rows),
            bytes_text(topic.stored_bytes),
            time_text(topic.start_ns),
            _duration_text(topic),
        )
    Terminal().print(table)
    print_attachments(info.attachments)
    for note in info.notes:
        topic_name = f"{note.topic}: " if note.topic else ""
        print_line(f"{time_text(note.created_ns)} {topic_name}{note.message}", style="yellow")


def print_attachments(attachments: Sequence[AttachmentInfo]) -> None:
    """Print the attachments of a sequence with the paths of their files; without attachments, print nothing."""
    if not attachments:
        return
    table = PlainTable("attachment", "media type", "size", "time", "file", numbers={"size"})
    for each in attachments:
        size, file = bytes_text(each.stored_bytes), str(each.path)
        table.add_row(each.name, each.media_type, size, time_text(each.log_ns), file)
    Terminal().print(table)


def print_topic(info: TopicInfo, first_rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a topic's counts, time span, files, metadata, columns and first rows."""
    from mosaico_ingest.view.texts import value_text

    print_line(f"{info.sequence}{info.name}", style="bold")
    facts = f"{info.ontology.tag}, {counted(info.rows, 'row')}, {bytes_text(info.stored_bytes)}"
    print_line(f"{facts}, {time_text(info.start_ns)} .. {time_text(info.end_ns)} UTC")
    for segment in info.segments:
        print_line(f"  {segment.path}")
    _print_metadata(info.metadata)
    rows = [f"row {number + 1}" for number in range(len(first_rows))]
    table = PlainTable("column", "type", *rows, numbers={"column"})
    table.columns[0].justify = "left"
    table.columns[1].style = "cyan"
    for path, column_type, values in _leaf_columns(info.schema, first_rows):
        table.add_row(path, column_type, *(value_text(value, CELL_WIDTH) for value in values))
    Terminal().print(table)


def attachment_json(info: AttachmentInfo) -> dict[str, Any]:
    """Return an attachment as JSON."""
    return {
        "name": info.name,
        "media_type": info.media_type,
        "log_ns": info.log_ns,
        "create_ns": info.create_ns,
        "stored_bytes": info.stored_bytes,
        "checksum": info.checksum,
        "file": str(info.path),
    }


def compact(
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="Sequences to compact; all if omitted.")
    ] = None,
    compression: Annotated[
        Compression, typer.Option("--compression", help="Compression of the merged files.")
    ] = Compression.FAST,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Merge the small files of sequences that many sessions wrote. Readers and writers can continue meanwhile.

    The replaced files stay for programs that opened them earlier; `ingest store gc` removes them. Incomplete
    sequences stay unchanged.

    Exit codes: 0 done, 5 a file is damaged.
    """
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.destinations.store.compaction import compact as compact_sequence
    from mosaico_ingest.errors import VerificationError

    opened = Store.open(store, create=False)
    results: list[dict[str, object]] = []
    replaced, damaged = 0, 0
    for name in sequences or opened.names():
        info = opened.sequence(name) if sequences else opened.find_sequence(name)
        if info is None or info.incomplete is not None:
            continue
        for result in compact_sequence(opened, info, compression=compression):
            where = f"{name}{result.topic}"
            results.append(
                {
                    "sequence": name,
                    "topic": result.topic,
                    "files": result.segments,
                    "bytes_before": result.bytes_before,
                    "bytes_after": result.bytes_after,
                    "problem": result.problem,
                }
            )
            if result.problem is not None:
                damaged += result.is_damaged
                print_line(f"{where}: not compacted: {result.problem}", stderr=True)
                continue
            replaced += result.segments
            if not as_json:
                sizes = f"{bytes_text(result.bytes_before)} -> {bytes_text(result.bytes_after)}"
                print_line(f"{where}: {result.segments} files -> 1, {sizes}")
    if as_json:
        print_json(results)
    elif replaced:
        print_line(f"`ingest store gc` removes the {counted(replaced, 'replaced file')}")
    else:
        print_line("nothing to compact")
    if damaged:
        raise VerificationError(
            f"damaged: {counted(damaged, 'run')} of files",
            where=store,
            hint="run `ingest verify`, and ingest their recordings again with if_exists: replace",
        )


def _metadata_filter(conditions: Iterable[str]) -> dict[str, str]:
    """Return the conditions `KEY=VALUE` as a mapping.

    Raises:
        typer.BadParameter: A condition has no `=`.
    """
    pairs = [condition.partition("=") for condition in conditions]
    for key, separator, _ in pairs:
        if not separator or not key:
            raise typer.BadParameter(f"{key!r} is not KEY=VALUE", param_hint="--metadata")
    return {key: value for key, _, value in pairs}


def _leaf_columns(
    fields: Iterable[pa.Field[Any]], rows: Sequence[Mapping[str, Any] | None], parent: str = ""
) -> Iterator[tuple[str, str, list[Any]]]:
    """Yield path, type and values of each column, and one line for a struct that is null in all rows."""
    from pyarrow.types import is_struct

    for field in fields:
        path = f"{parent}{field.name}"
        values = [None if row is None else row[field.name] for row in rows]
        if not is_struct(field.type):
            yield path, f"{field.type}{'' if field.nullable else ' not null'}", values
        elif rows and all(value is None for value in values):
            yield f"{path}.*", f"{field.type.num_fields} columns", values
        else:
            yield from _leaf_columns(field.type, values, f"{path}.")


def _print_metadata(metadata: Mapping[str, Any]) -> None:
    from mosaico_ingest.view.texts import value_text

    for name, value in _metadata_lines(metadata):
        print_line(f"  {name}: {value_text(value, METADATA_WIDTH)}")


def _metadata_lines(metadata: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield names and values; the provenance, which is for programs, is reduced to tool and files."""
    for key, value in metadata.items():
        if key == ATTACHMENTS_KEY:
            continue
        if not isinstance(value, dict) or not value:
            yield key, value
        elif key == PROVENANCE_KEY and "sources" in value:
            names = (str(source["name"]) for source in value["sources"])
            yield key, f"{value.get('tool')} from {', '.join(names)}"
        else:
            yield from ((f"{key}.{name}", member) for name, member in value.items())


def _duration_text(info: SequenceSummary | TopicInfo) -> str:
    if info.start_ns is None or info.end_ns is None:
        return "-"
    return seconds_text((info.end_ns - info.start_ns) / 1e9)


def _summary_json(summary: SequenceSummary) -> dict[str, Any]:
    return {
        "name": summary.name,
        "metadata": dict(summary.metadata),
        "topics": summary.topics,
        "rows": summary.rows,
        "stored_bytes": summary.stored_bytes,
        "start_ns": summary.start_ns,
        "end_ns": summary.end_ns,
        "incomplete": summary.incomplete,
        "notes": [{"topic": note.topic, "message": note.message} for note in summary.notes],
    }


def _topic_json(info: TopicInfo) -> dict[str, Any]:
    return {
        "sequence": info.sequence,
        "name": info.name,
        "ontology": info.ontology.tag,
        "rows": info.rows,
        "stored_bytes": info.stored_bytes,
        "start_ns": info.start_ns,
        "end_ns": info.end_ns,
        "checksum": info.checksum,
        "metadata": dict(info.metadata),
        "files": [str(segment.path) for segment in info.segments],
        "schema": {field.name: str(field.type) for field in info.schema},
    }


_COMMANDS = {
    "ls": list_sequences, "show": show, "head": head, "tail": tail, "sample": sample, "describe": describe, "plot": plot,
    "image": image, "sql": sql, "page": page, "compact": compact, "gc": gc, "rm": remove,
}  # fmt: skip
for _name, _command in _COMMANDS.items():
    store_app.command(_name)(_command)
