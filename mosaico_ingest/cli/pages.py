"""`ingest store page` and `browse`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.cli.options import DEFAULT_STORE, StoreOption, write_output

DEFAULT_PORT = 6780


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


def browse(
    store: Annotated[
        str, typer.Argument(metavar="[STORE]", help="Folder or URL of the store.")
    ] = DEFAULT_STORE,
    port: Annotated[
        int,
        typer.Option("--port", min=0, max=65535, metavar="PORT", help="Port to listen on; 0 chooses one."),
    ] = DEFAULT_PORT,
    runs: Annotated[
        Path | None,
        typer.Option(
            "--runs",
            metavar="FOLDER",
            help="Folder with reports (`--report`), whose pages are listed.",
            show_default="STORE/runs",
        ),
    ] = None,
) -> None:
    """Show the sequences and runs of a store in a web browser on this machine, until interrupted. Read-only."""
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas, interrupt_on_sigterm
    from mosaico_ingest.pages.browser import BrowserServer

    collect_garbage_as_usual()
    hide_pandas()
    interrupt_on_sigterm()
    server = BrowserServer(store, port, runs=runs)
    try:
        typer.echo(f"showing {store} at {server.address}")
        server.serve_forever()
    except KeyboardInterrupt:
        typer.echo("stopping")
    finally:
        server.close()
