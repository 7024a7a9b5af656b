"""This file is `ingest report`: a run's report as a page for people."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["report"]


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
    from mosaico_ingest.cli.tables import print_report
    from mosaico_ingest.report.markdown import markdown_summary
    from mosaico_ingest.report.page import html_page
    from mosaico_ingest.report.write import read_report
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
