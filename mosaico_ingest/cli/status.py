"""This file is `ingest status`: which of a job's recordings are done, changed, new or failed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["status"]

STYLES = {"done": "green", "new": "cyan", "changed": "yellow", "failed": "red", "unreadable": "red"}


def status(
    manifests: Annotated[list[Path], typer.Argument(metavar="JOB.yaml", help="Job manifests.")],
    *,
    check: Annotated[bool, typer.Option("--check", help="Exit 1 unless every recording is done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say of every recording whether its sequence is there, whole and of the same content; writes nothing."""
    import json
    from collections import Counter
    from dataclasses import asdict

    from rich.text import Text

    from mosaico_ingest import api
    from mosaico_ingest.cli.console import plain_table
    from mosaico_ingest.cli.tables import open_console, print_json

    found = [one for manifest in manifests for one in api.job_status(manifest)]
    if as_json:
        print_json(json.dumps([asdict(one) for one in found], indent=2))
    else:
        table = plain_table("sequence", "status", "recording")
        for one in found:
            style = STYLES[one.standing.value]
            files = ", ".join(one.files)
            known = one.why.startswith(files)  # an error says where it is from
            said = one.why if known else f"{files}: {one.why}" if one.why else files
            table.add_row(one.sequence, Text(one.standing.value, style=style), Text(said))
        console = open_console()
        console.print(table)
        counts = Counter(one.standing.value for one in found)
        console.print(", ".join(f"{count} {name}" for name, count in counts.items()), soft_wrap=True)
    if check and any(one.standing.value != "done" for one in found):
        raise typer.Exit(1)
