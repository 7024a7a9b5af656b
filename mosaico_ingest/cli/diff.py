"""This file is `ingest diff`: what changes in the plan from one manifest to the other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["diff"]


def diff(
    before: Annotated[Path, typer.Argument(metavar="BEFORE.yaml", help="A job manifest.")],
    after: Annotated[Path, typer.Argument(metavar="AFTER.yaml", help="The one to compare with it.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare what two manifests would do with their recordings: topics, adapters, metadata, target.

    Exit codes: 0 the plans are the same, 1 they differ.
    """
    import json
    from dataclasses import asdict

    from mosaico_ingest import api
    from mosaico_ingest.cli.plan_tables import print_differences
    from mosaico_ingest.cli.tables import print_json

    found = api.compare_jobs(before, after)
    if as_json:
        print_json(json.dumps([asdict(one) for one in found], indent=2, ensure_ascii=False))
    else:
        print_differences(found)
    if found:
        raise typer.Exit(1)
