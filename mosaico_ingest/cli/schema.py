"""This file is `ingest schema`: the JSON Schemas of what the tool reads and writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["schema"]


def schema(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="job, adapter or report; without it, the names.")
    ] = None,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="DIR", help="Write every schema into a folder.")
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option("--check", metavar="DIR", help="Fail if a schema in a folder is not current."),
    ] = None,
) -> None:
    """Print the JSON Schema (draft 2020-12) of job manifests, adapter files or reports."""
    texts = {known: _text(make()) for known, make in _schemas().items()}
    if write is not None:
        write.mkdir(parents=True, exist_ok=True)
        for known, text in texts.items():
            (write / _file_name(known)).write_text(text, encoding="utf-8")
    elif check is not None:
        _check(check, texts)
    elif name is None:
        typer.echo("\n".join(texts))
    elif name in texts:
        typer.echo(texts[name], nl=False)
    else:
        raise typer.BadParameter(f"{name!r} is none of {', '.join(texts)}", param_hint="NAME")


def _schemas() -> dict[str, Callable[[], dict[str, Any]]]:
    from mosaico_ingest.adapters.mapping.schema import adapter_schema
    from mosaico_ingest.manifest.schema import job_schema
    from mosaico_ingest.report.model import report_schema

    return {"job": job_schema, "adapter": adapter_schema, "report": report_schema}


def _check(folder: Path, texts: dict[str, str]) -> None:
    stale = [known for known, text in texts.items() if _committed(folder / _file_name(known)) != text]
    if stale:
        names = ", ".join(_file_name(known) for known in stale)
        typer.echo(
            f"error: {folder} is not current: {names} — run `ingest schema --write {folder}`", err=True
        )
        raise typer.Exit(1)


def _committed(path: Path) -> str | None:
    return path.read_text(encoding="utf-8") if path.is_file() else None


def _file_name(name: str) -> str:
    return f"{name}.schema.json"


def _text(schema: dict[str, Any]) -> str:
    import json

    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
