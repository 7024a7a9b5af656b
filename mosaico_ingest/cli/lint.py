"""This file is `ingest lint`: judges manifests, adapters and `.msg` files, and mends what is safe to mend."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mosaico_ingest.lint.engine import LintReport

__all__ = ["lint"]

_TEXT = "text"


def lint(
    paths: Annotated[
        list[str] | None,
        typer.Argument(metavar="FILE|DIR|-", help="What to judge; a folder with all below it; - is stdin."),
    ] = None,
    *,
    output: Annotated[
        str, typer.Option("--format", help="text, json, sarif, github or junit.", metavar="FORMAT")
    ] = _TEXT,
    fix: Annotated[bool, typer.Option("--fix", help="Make the changes that are safe to make.")] = False,
    no_env: Annotated[bool, typer.Option("--no-env", help="Miss no environment variable.")] = False,
    explain: Annotated[
        str | None,
        typer.Option("--explain", help="Print a rule's page; all lists the rules.", metavar="RULE"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")] = False,
) -> None:
    """Judge job manifests, adapter files and .msg files without opening a recording.

    Exit codes: 0 clean, 1 failure, 2 usage, 3 nothing to judge, 10 infos, 11 warnings, 12 errors; SARIF: 0 for findings.
    """
    from mosaico_ingest.cli.collector import collect_as_usual
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
    from mosaico_ingest.cli.console import Terminal
    from mosaico_ingest.cli.render import render_findings, texts_of

    console = Terminal(soft_wrap=True)
    if report.findings:
        texts = {**texts_of(report.findings), **{judged.file: judged.text for judged in report.files}}
        console.print(render_findings(report.findings, texts))
    if not quiet:
        Terminal(stderr=True, soft_wrap=True).print(_summary(report), style="bold")


def _summary(report: LintReport) -> str:
    from mosaico_ingest.report.units import counted

    if not report.files:
        return "nothing to judge: no manifest, adapter or .msg file"
    found, fixed = len(report.findings), sum(judged.fixed for judged in report.files)
    mended = f", {counted(fixed, 'change')} made" if fixed else ""
    return f"{counted(len(report.files), 'file')}, {counted(found, 'finding')}{mended}"


def _explanation(rule: str) -> str:
    from mosaico_ingest.lint.pages import index, page
    from mosaico_ingest.lint.rules import RULES
    from mosaico_ingest.lint.settings import NAMES
    from mosaico_ingest.manifest.problems import nearest

    if rule == "all":
        return index()
    if rule not in NAMES:
        close = nearest(rule, NAMES)
        hint = f"; did you mean {close!r}?" if close else "; `--explain all` lists them"
        raise typer.BadParameter(f"there is no rule {rule!r}{hint}", param_hint="--explain")
    return page(next(known for known in RULES if known.name == NAMES[rule]))
