"""This file is `ingest store`: what the embedded store holds, and its tidying."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(no_args_is_help=True, help="Look into the embedded store.")

Folder = Annotated[str, typer.Option("--store", help="The store's folder or URL.", metavar="DIR|URL")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
DEFAULT = "mosaico"


@app.command("ls")
def list_sequences(store: Folder = DEFAULT, as_json: AsJson = False) -> None:
    """List the sequences."""
    from mosaico_ingest.cli.store_tables import print_sequences
    from mosaico_ingest.store import Store

    print_sequences(Store.open(store, create=False).sequences(), as_json=as_json)


@app.command()
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
    from mosaico_ingest.cli.store_tables import print_sequence, print_topic
    from mosaico_ingest.store import Store

    opened = Store.open(store, create=False)
    sequence, slash, topic = what.lstrip("/").partition("/")
    if not slash or not topic:
        print_sequence(opened.sequence(sequence), as_json=as_json)
        return
    info = opened.topic(sequence, topic)
    print_topic(info, opened.scan(sequence, topic), rows=rows, as_json=as_json)


@app.command()
def gc(store: Folder = DEFAULT) -> None:
    """Remove what interrupted runs have left behind; what is committed and what is being written stays."""
    from mosaico_ingest.report.units import bytes_text
    from mosaico_ingest.store import Store

    removed = Store.open(store, create=False).collect_garbage()
    typer.echo(
        f"{removed.sessions} dead sessions and {removed.files} files removed, {bytes_text(removed.stored_bytes)} freed"
    )


@app.command("rm")
def remove(
    sequence: Annotated[
        str, typer.Argument(metavar="SEQUENCE", help="The sequence to remove, with all its files.")
    ],
    store: Folder = DEFAULT,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Remove a sequence."""
    from mosaico_ingest.report.units import bytes_text, count_text
    from mosaico_ingest.store import Store

    opened = Store.open(store, create=False)
    info = opened.sequence(sequence)
    size = f"{count_text(info.rows)} rows, {bytes_text(info.stored_bytes)}"
    if not yes:
        typer.confirm(f"remove {sequence} ({size}) from {store}?", abort=True)
    opened.delete_sequence(sequence)
    typer.echo(f"{sequence} removed ({size})")
