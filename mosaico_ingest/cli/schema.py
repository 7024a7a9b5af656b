"""This file is `ingest schema`: the JSON Schemas of the files this tool reads and writes."""

from __future__ import annotations

import json
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["schema"]


class Document(str, Enum):
    """The files that have a schema."""

    JOB = "job"
    ADAPTER = "adapter"
    PLAN = "plan"
    REPORT = "report"


def schema(
    document: Annotated[
        Document | None, typer.Argument(metavar="DOCUMENT", help="Which file's schema to print.")
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="DIR", help="Write NAME.schema.json into DIR, for editors."),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", metavar="DIR", help="Fail where a file in DIR is not up to date."),
    ] = None,
) -> None:
    """Print, write or check the JSON Schemas (draft 2020-12); to write or check all of them, name none."""
    from mosaico_ingest.textfile import write_whole

    wanted = [document] if document else list(Document)
    if write is None and check is None and document is None:
        raise typer.BadParameter("name one of " + ", ".join(one.value for one in Document))
    stale = 0
    for one in wanted:
        text = _text(one)
        if write is not None:
            write_whole(_file(write, one), text)
        elif check is not None:
            stale += _is_stale(_file(check, one), text)
        else:
            typer.echo(text, nl=False)
    if stale:
        raise typer.Exit(1)


def _text(document: Document) -> str:
    from mosaico_ingest.adapters.mapping.schema import adapter_schema
    from mosaico_ingest.manifest.schema import job_schema
    from mosaico_ingest.plan.schema import plan_schema
    from mosaico_ingest.report.schema import report_schema

    makers: dict[Document, Callable[[], dict[str, Any]]] = {
        Document.JOB: job_schema,
        Document.ADAPTER: adapter_schema,
        Document.PLAN: plan_schema,
        Document.REPORT: report_schema,
    }
    return json.dumps(makers[document](), indent=2, ensure_ascii=False) + "\n"


def _file(folder: Path, document: Document) -> Path:
    return folder / f"{document.value}.schema.json"


def _is_stale(path: Path, text: str) -> bool:
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return False
    typer.echo(f"{path} is not up to date — run `ingest schema --write {path.parent}`", err=True)
    return True
