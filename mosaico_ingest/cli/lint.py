"""`ingest lint` and `schema`."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from mosaico_ingest.lint.engine import LintReport

__all__ = [
    "lint",
    "schema",
]


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
    from mosaico_ingest.adapters.mapping.model import adapter_schema
    from mosaico_ingest.job.reference import job_schema
    from mosaico_ingest.pipeline.plan import plan_schema
    from mosaico_ingest.report.model import report_schema

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


_TEXT = "text"


def lint(
    paths: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FILE|DIR|-", help="What to check: files, folders with everything below, or - for stdin."
        ),
    ] = None,
    *,
    output: Annotated[
        str, typer.Option("--format", help="text, json, sarif, github or junit.", metavar="FORMAT")
    ] = _TEXT,
    fix: Annotated[bool, typer.Option("--fix", help="Apply the fixes that are safe.")] = False,
    no_env: Annotated[
        bool, typer.Option("--no-env", help="Do not report unset environment variables.")
    ] = False,
    explain: Annotated[
        str | None,
        typer.Option("--explain", help="Print the page of a rule, or the list of all rules.", metavar="RULE"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
) -> None:
    """Check job manifests, adapter files and .msg files without opening any recording.

    Exit codes: 0 no findings, 1 failure, 2 usage, 3 nothing to lint, 10 infos, 11 warnings, 12 errors; SARIF: 0 for findings.
    """
    from mosaico_ingest.cli.process import collect_as_usual
    from mosaico_ingest.lint.engine import STDIN, lint_paths
    from mosaico_ingest.lint.formats import FORMATS

    collect_as_usual()
    if explain is not None:
        typer.echo(_explanation(explain), nl=False)
        return
    if not paths:
        raise typer.BadParameter("name a file or a folder", param_hint="FILE|DIR|-")
    if output not in {_TEXT, *FORMATS}:
        raise typer.BadParameter(f"{output!r} is none of text, {', '.join(FORMATS)}", param_hint="--format")
    missing = [path for path in paths if path != STDIN and not Path(path).exists()]
    if missing:
        raise typer.BadParameter(f"there is no {missing[0]}", param_hint="FILE|DIR|-")
    stdin = sys.stdin.read() if STDIN in paths else None
    report = lint_paths(paths, env=None if no_env else os.environ, fix=fix, stdin=stdin)
    if output == _TEXT:
        _print_text(report, quiet=quiet)
    else:
        typer.echo(FORMATS[output](report), nl=False)
    if report.exit_code and (output != "sarif" or not report.files):
        raise typer.Exit(report.exit_code)


def _print_text(report: LintReport, *, quiet: bool) -> None:
    from mosaico_ingest.cli.console import Terminal, render_findings, texts_of

    console = Terminal(soft_wrap=True)
    if report.findings:
        texts = {**texts_of(report.findings), **{linted.file: linted.text for linted in report.files}}
        console.print(render_findings(report.findings, texts))
    if not quiet:
        Terminal(stderr=True, soft_wrap=True).print(_summary(report), style="bold")


def _summary(report: LintReport) -> str:
    from mosaico_ingest.findings import a_few, one_line
    from mosaico_ingest.report.units import counted

    skipped = ""
    if report.skipped:
        names = a_few(one_line(skip.file) for skip in report.skipped)
        skipped = f"\n{counted(len(report.skipped), 'file')} skipped (not a manifest or an adapter): {names}"
    if not report.files:
        return f"nothing to lint: no manifest, adapter or .msg file{skipped}"
    fixed = sum(linted.fixed for linted in report.files)
    fixes = f", {counted(fixed, 'change')} made" if fixed else ""
    return f"{counted(len(report.files), 'file')}, {counted(len(report.findings), 'finding')}{fixes}{skipped}"


def _explanation(name: str) -> str:
    from mosaico_ingest.job.validation import nearest
    from mosaico_ingest.lint.pages import page_of, rule_index
    from mosaico_ingest.rules import RULES, find_rule

    if name == "all":
        return rule_index()
    rule = find_rule(name)
    if rule is None:
        close = nearest(name, RULES)
        hint = f"; did you mean {close!r}?" if close else "; `--explain all` lists them"
        raise typer.BadParameter(f"there is no rule {name!r}{hint}", param_hint="--explain")
    return page_of(rule)
