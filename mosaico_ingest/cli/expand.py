"""This file is `ingest expand`: what a manifest says once it has what it extends, and each job of its matrix."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mosaico_ingest.manifest.expand import Expanded

__all__ = ["expand"]


def expand(
    manifest: Annotated[Path, typer.Argument(metavar="JOB.yaml", help="A job manifest.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list of the jobs.")] = False,
) -> None:
    """Print every job of a manifest as a manifest of its own; variables of the environment stay as they are.

    What another file says has a comment with its place; paths are seen from the manifest's folder.
    """
    import json

    from mosaico_ingest.cli.tables import print_json
    from mosaico_ingest.manifest.expand import expand_manifest
    from mosaico_ingest.manifest.text import to_yaml

    jobs = expand_manifest(manifest)
    if as_json:
        print_json(json.dumps([job.value for job in jobs], indent=2, ensure_ascii=False))
        return
    typer.echo(
        "---\n".join(f"{_head(manifest, job)}{to_yaml(job.value, job.remark)}" for job in jobs), nl=False
    )


def _head(manifest: Path, job: Expanded) -> str:
    cell = ", ".join(f"{name}={value}" for name, value in job.cell.items())
    return f"# {manifest}: {cell}\n" if cell else ""
