"""`ingest store` and `verify`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mosaico_ingest.cli.console import plain_table
from mosaico_ingest.cli.report import open_console, print_json
from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.report.units import (
    bytes_text,
    count_text,
    seconds_text,
    time_text,
)

if TYPE_CHECKING:
    import pyarrow as pa

    from mosaico_ingest.destinations.store import SequenceInfo, TopicInfo

__all__ = [
    "print_sequence",
    "print_sequences",
    "print_topic",
    "store_app",
    "verify",
]

LONGEST_VALUE = 100
"""Characters of one value before it is cut; images and clouds are long."""
_TYPE_WIDTH, _CELL_WIDTH = 28, 24


def print_sequences(sequences: Sequence[SequenceInfo], *, as_json: bool) -> None:
    """Print a line for each sequence, and what ended the run of one that is not whole."""
    if as_json:
        print_json(json.dumps([_sequence_json(info) for info in sequences], indent=2))
        return
    if not sequences:
        open_console().print("no sequences")
        return
    table = _table("sequence", topics=True, rows=True, size=True, start=False, duration=True)
    for info in sequences:
        size = bytes_text(info.stored_bytes)
        table.add_row(
            info.name,
            str(len(info.topics)),
            count_text(info.rows),
            size,
            time_text(info.start_ns),
            _span(info),
        )
    console = open_console()
    console.print(table)
    for info in sequences:
        if info.incomplete is not None:
            console.print(Text(f"{info.name}: incomplete: {info.incomplete}", style="red"), soft_wrap=True)
        elif info.notes:  # the others are in `store show`
            console.print(Text(f"{info.name}: {info.notes[-1].message}", style="yellow"), soft_wrap=True)


def print_sequence(info: SequenceInfo, *, as_json: bool) -> None:
    """Print a sequence's metadata, topics and notes."""
    if as_json:
        topics = [_topic_json(topic) for topic in info.topics]
        print_json(json.dumps({**_sequence_json(info), "topics": topics}, indent=2))
        return
    console = open_console()
    console.print(Text(info.name, style="bold"))
    _print_metadata(info.metadata, console)
    table = _table("topic", ontology=False, rows=True, size=True, start=False, duration=True)
    for topic in info.topics:
        size = bytes_text(topic.stored_bytes)
        table.add_row(
            topic.name,
            topic.ontology.tag,
            count_text(topic.rows),
            size,
            time_text(topic.start_ns),
            _span(topic),
        )
    console.print(table)
    for note in info.notes:
        place = f"{note.topic}: " if note.topic else ""
        console.print(
            Text(f"{time_text(note.created_ns)} {place}{note.message}", style="yellow"), soft_wrap=True
        )


def print_topic(info: TopicInfo, reader: pa.RecordBatchReader, *, rows: int, as_json: bool) -> None:
    """Print a topic's counts, time span, files, metadata, columns and first rows."""
    first = _first_rows(reader, rows)
    if as_json:
        print_json(json.dumps({**_topic_json(info), "first_rows": first}, indent=2, default=_plain))
        return
    console = open_console()
    console.print(Text(f"{info.sequence}{info.name}", style="bold"))
    facts = f"{info.ontology.tag}, {count_text(info.rows)} rows, {bytes_text(info.stored_bytes)}"
    console.print(f"{facts}, {time_text(info.start_ns)} .. {time_text(info.end_ns)} UTC")
    for segment in info.segments:
        console.print(Text(f"  {segment.path}"), soft_wrap=True)
    _print_metadata(info.metadata, console)
    console.print(_columns(info.schema, first))


def _columns(schema: pa.Schema, first: Sequence[Mapping[str, Any]]) -> Table:
    """Return a line for each column, those of structs too: its path, its type, its values in the first rows."""
    table = plain_table()
    table.add_column("column", no_wrap=True)
    table.add_column("type", style="cyan", max_width=_TYPE_WIDTH, no_wrap=True)
    for number in range(len(first)):
        table.add_column(f"row {number + 1}", max_width=_CELL_WIDTH, no_wrap=True)
    for path, kind, values in _leaves(schema, first):
        table.add_row(Text(path), Text(kind), *(Text(_cell(value)) for value in values))
    return table


def _leaves(
    fields: Iterable[pa.Field[Any]], rows: Sequence[Mapping[str, Any] | None], above: str = ""
) -> Iterator[tuple[str, str, list[Any]]]:
    """Yield path, type and values of each column; those of a struct that no row has are one."""
    from pyarrow.types import is_struct

    for field in fields:
        path = f"{above}{field.name}"
        values = [None if row is None else row[field.name] for row in rows]
        if not is_struct(field.type):
            yield path, f"{field.type}{'' if field.nullable else ' not null'}", values
        elif rows and all(value is None for value in values):
            yield f"{path}.*", f"{field.type.num_fields} columns", values
        else:
            yield from _leaves(field.type, values, f"{path}.")


def _print_metadata(metadata: Mapping[str, Any], console: Console) -> None:
    for name, value in _metadata_lines(metadata):
        console.print(Text(f"  {name}: {_cell(value)}"), soft_wrap=True)


def _metadata_lines(metadata: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield names and values; of what the provenance keeps for programs, the few words a person wants."""
    for key, value in metadata.items():
        if not isinstance(value, dict) or not value:
            yield key, value
        elif key == PROVENANCE_KEY and "sources" in value:
            names = (str(source["name"]) for source in value["sources"])
            yield key, f"{value.get('tool')} from {', '.join(names)}"
        else:
            yield from ((f"{key}.{name}", part) for name, part in value.items())


def _cell(value: object) -> str:
    return "-" if value is None else _cut(value).replace("\n", "\\n")


def _first_rows(reader: pa.RecordBatchReader, rows: int) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    with reader:
        for batch in reader:
            if len(found) >= rows:
                break
            found += batch.slice(0, rows - len(found)).to_pylist()
    return found


def _table(first: str, **columns: bool) -> Table:
    table = plain_table(first)
    for name, right in columns.items():
        table.add_column(name, justify="right" if right else "left", no_wrap=right)
    return table


def _span(info: SequenceInfo | TopicInfo) -> str:
    if info.start_ns is None or info.end_ns is None:
        return "-"
    return seconds_text((info.end_ns - info.start_ns) / 1e9)


def _sequence_json(info: SequenceInfo) -> dict[str, Any]:
    return {
        "name": info.name,
        "metadata": dict(info.metadata),
        "topics": len(info.topics),
        "rows": info.rows,
        "stored_bytes": info.stored_bytes,
        "start_ns": info.start_ns,
        "end_ns": info.end_ns,
        "incomplete": info.incomplete,
        "notes": [{"topic": note.topic, "message": note.message} for note in info.notes],
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


def _cut(value: object) -> str:
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    text = str(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}… ({len(text)} characters)"


def _plain(value: object) -> object:
    """Say what a value that JSON has no form for is."""
    return f"<{len(value)} bytes>" if isinstance(value, bytes) else str(value)


def verify(
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="Which ones; all without a name.")
    ] = None,
    store: Annotated[
        str, typer.Option("--store", help="The store's folder or URL.", metavar="DIR|URL")
    ] = "mosaico",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Read stored sequences back and hold every page and all rows against their checksums; exit 5 where they differ."""
    import json

    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.cli.process import collect_as_usual, forgo_pandas
    from mosaico_ingest.cli.report import print_json
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.destinations.store.store import verify as verify_sequence
    from mosaico_ingest.errors import VerificationError
    from mosaico_ingest.report.units import bytes_text, counted

    collect_as_usual()
    forgo_pandas()
    opened = Store.open(store, create=False)
    infos = [opened.sequence(name) for name in sequences] if sequences else opened.sequences()
    checked = {info.name: list(verify_sequence(info)) for info in infos}
    bad = [
        {"sequence": name, "topic": one.topic, "file": str(one.segment.path), "problem": one.problem}
        for name, found in checked.items()
        for one in found
        if one.problem is not None
    ]
    incomplete = {info.name: info.incomplete for info in infos if info.incomplete is not None}
    rows = sum(one.segment.rows for found in checked.values() for one in found)
    size = sum(one.segment.stored_bytes for found in checked.values() for one in found)
    if as_json:
        print_json(
            json.dumps(
                {
                    "sequences": list(checked),
                    "rows": rows,
                    "bytes": size,
                    "problems": bad,
                    "incomplete": incomplete,
                }
            )
        )
    else:
        for one in bad:
            print_line(f"{one['sequence']}{one['topic']}: {one['file']}: {one['problem']}", stderr=True)
        for name, reason in incomplete.items():
            print_line(f"{name}: incomplete: {reason}", stderr=True)
    if bad or incomplete:
        what = [f"{counted(len(bad), 'file')} not as written"] if bad else []
        what += [f"{counted(len(incomplete), 'sequence')} incomplete"] if incomplete else []
        raise VerificationError(
            ", ".join(what),
            where=store,
            hint="ingest their recordings again with if_exists: replace",
        )
    if not as_json:
        typer.echo(
            f"{counted(len(checked), 'sequence')}, {counted(rows, 'row')} in {bytes_text(size)}: all as written"
        )


store_app = typer.Typer(no_args_is_help=True, help="Look into the embedded store.")

Folder = Annotated[str, typer.Option("--store", help="The store's folder or URL.", metavar="DIR|URL")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DEFAULT = "mosaico"


@store_app.command("ls")
def list_sequences(store: Folder = DEFAULT, as_json: AsJson = False) -> None:
    """List the sequences."""
    from mosaico_ingest.destinations.store import Store

    print_sequences(Store.open(store, create=False).sequences(), as_json=as_json)


@store_app.command()
def show(
    what: Annotated[
        str, typer.Argument(metavar="SEQUENCE[/TOPIC]", help="A sequence, or one of its topics.")
    ],
    store: Folder = DEFAULT,
    rows: Annotated[
        int, typer.Option("--rows", min=0, help="How many of a topic's first rows to print.")
    ] = 3,
    as_json: AsJson = False,
) -> None:
    """Show a sequence's topics, or a topic's schema, counts, time span, metadata and first rows."""
    from mosaico_ingest.destinations.store import Store

    opened = Store.open(store, create=False)
    sequence, slash, topic = what.lstrip("/").partition("/")
    if not slash or not topic:
        print_sequence(opened.sequence(sequence), as_json=as_json)
        return
    info = opened.topic(sequence, topic)
    print_topic(info, opened.scan(sequence, topic), rows=rows, as_json=as_json)


@store_app.command()
def gc(store: Folder = DEFAULT) -> None:
    """Remove what interrupted runs have left behind; what is committed and what is being written stays."""
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.report.units import bytes_text

    removed = Store.open(store, create=False).collect_garbage()
    typer.echo(
        f"{removed.sessions} dead sessions and {removed.files} files removed, {bytes_text(removed.stored_bytes)} freed"
    )


@store_app.command("rm")
def remove(
    sequence: Annotated[
        str, typer.Argument(metavar="SEQUENCE", help="The sequence to remove, with all its files.")
    ],
    store: Folder = DEFAULT,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Remove a sequence."""
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.report.units import bytes_text, count_text

    opened = Store.open(store, create=False)
    info = opened.sequence(sequence)
    size = f"{count_text(info.rows)} rows, {bytes_text(info.stored_bytes)}"
    if not yes:
        typer.confirm(f"remove {sequence} ({size}) from {store}?", abort=True)
    opened.delete_sequence(sequence)
    typer.echo(f"{sequence} removed ({size})")
