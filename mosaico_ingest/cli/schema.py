"""`ingest schema`: JSON Schemas of files, and the lock file of a manifest."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from mosaico_ingest.cli.options import JunitOption, SarifOption
from mosaico_ingest.errors import IngestError

schema_app = typer.Typer()


class Document(str, Enum):
    """Files that have a JSON Schema."""

    JOB = "job"
    ADAPTER = "adapter"
    PLAN = "plan"
    REPORT = "report"
    LOCK = "lock"


WriteOption = Annotated[
    Path | None,
    typer.Option("--write", metavar="DIR", help="Write NAME.schema.json into DIR, for editors."),
]
CheckOption = Annotated[
    Path | None,
    typer.Option("--check", metavar="DIR", help="Fail if a schema in DIR is not up to date."),
]


@schema_app.callback(invoke_without_command=True)
def schema(context: typer.Context, write: WriteOption = None, check: CheckOption = None) -> None:
    """Print, write or check the JSON Schemas (draft 2020-12) of files, or lock message definitions.

    Without a command, --write and --check apply to all schemas.
    """
    if context.invoked_subcommand is None:
        if write is None and check is None:
            choices = ", ".join(choice.value for choice in Document)
            raise typer.BadParameter(f"give one of {choices}", param_hint="COMMAND")
        write_schemas(list(Document), write, check)


@schema_app.command()
def job(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of job manifests."""
    write_schemas([Document.JOB], write, check)


@schema_app.command()
def adapter(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of adapter files."""
    write_schemas([Document.ADAPTER], write, check)


@schema_app.command()
def plan(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of plan files."""
    write_schemas([Document.PLAN], write, check)


@schema_app.command()
def report(write: WriteOption = None, check: CheckOption = None) -> None:
    """Print the JSON Schema of report files."""
    write_schemas([Document.REPORT], write, check)


@schema_app.command()
def lock(
    manifest: Annotated[
        Path | None, typer.Argument(metavar="JOB.yaml", help="A job manifest.", show_default=False)
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compare the recordings with the lock file; write nothing.")
    ] = False,
    junit: JunitOption = None,
    sarif: SarifOption = None,
) -> None:
    """Write the types, fields and output columns of every selected topic to JOB.lock.json.

    With `definitions: locked` in the manifest, plans and runs refuse recordings that differ from this file. Without a
    manifest, print the JSON Schema of lock files. Exit codes of --check: 0 equal, 6 different. --junit and --sarif write
    the result of --check.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.report.units import counted

    ci_options = [name for name, value in (("--junit", junit), ("--sarif", sarif)) if value is not None]
    if manifest is None and (check or ci_options):
        raise typer.BadParameter("give a manifest", param_hint="JOB.yaml")
    if ci_options and not check:
        raise typer.BadParameter("add --check", param_hint=", ".join(ci_options))
    if manifest is None:
        write_schemas([Document.LOCK], None, None)
        return
    from mosaico_ingest.services.schemas import check_locked, write_lock

    collect_garbage_as_usual()
    jobs = api.compile_job(manifest, locked=False)
    hide_pandas(jobs)
    if check:
        with _ci_files(manifest, junit, sarif):
            count = check_locked(manifest, jobs)
        print_line(f"{counted(count, 'recording')}: no differences", style="green")
        return
    result = write_lock(manifest, jobs)
    for difference in result.differences:
        print_line(str(difference))
    topics = counted(len(result.lock.topics), "topic")
    state = "" if result.is_new else f", {counted(len(result.differences), 'difference')}"
    print_line(f"{result.path}: {topics}{state}", style="bold")


@contextmanager
def _ci_files(manifest: Path, junit: Path | None, sarif: Path | None) -> Generator[None]:
    """Write the outcome of a check of the lock file as JUnit XML and SARIF, even if the check raises."""
    error: IngestError | None = None
    try:
        yield
    except IngestError as caught:
        error = caught
        raise
    finally:
        if junit is not None or sarif is not None:
            from mosaico_ingest.cli.ci import CheckedRecording, write_ci_files

            text, findings = (None, ()) if error is None else (str(error), error.findings)
            outcome = CheckedRecording(f"schema lock {manifest}", error=text, findings=findings)
            write_ci_files([outcome], junit=junit, sarif=sarif)


def write_schemas(documents: Sequence[Document], write: Path | None, check: Path | None) -> None:
    """Print the schemas, write them into the folder `write`, or compare them with those in the folder `check`.

    Raises:
        typer.Exit: A schema is not up to date.
    """
    from mosaico_ingest.documents import write_atomically

    stale = 0
    for each in documents:
        text = _schema_text(each)
        if write is not None:
            write_atomically(_schema_file(write, each), text)
        elif check is not None:
            stale += _is_stale(_schema_file(check, each), text)
        else:
            typer.echo(text, nl=False)
    if stale:
        raise typer.Exit(1)


def _schema_text(document: Document) -> str:
    from mosaico_ingest.pipeline.definition_changes import lock_schema
    from mosaico_ingest.pipeline.plan_document import plan_schema
    from mosaico_ingest.report.files import report_schema
    from mosaico_ingest.services.schemas import adapter_editor_schema, job_editor_schema

    schemas: dict[Document, Callable[[], dict[str, Any]]] = {
        Document.JOB: job_editor_schema,
        Document.ADAPTER: adapter_editor_schema,
        Document.PLAN: plan_schema,
        Document.REPORT: report_schema,
        Document.LOCK: lock_schema,
    }
    return json.dumps(schemas[document](), indent=2, ensure_ascii=False) + "\n"


def _schema_file(folder: Path, document: Document) -> Path:
    return folder / f"{document.value}.schema.json"


def _is_stale(path: Path, text: str) -> bool:
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return False
    typer.echo(f"{path} is not up to date — run `ingest schema --write {path.parent}`", err=True)
    return True
