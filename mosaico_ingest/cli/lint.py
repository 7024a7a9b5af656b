"""`ingest lint`."""

from __future__ import annotations

import os
import sys
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mosaico_ingest.lint.engine import LintReport


class OutputFormat(str, Enum):
    """Formats of findings."""

    TEXT = "text"
    JSON = "json"
    SARIF = "sarif"
    GITHUB = "github"
    JUNIT = "junit"


def lint(
    paths: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FILE|DIR|-", help="Files to check; folders include their subfolders, - reads stdin."
        ),
    ] = None,
    *,
    output_format: Annotated[
        OutputFormat, typer.Option("--format", help="Format of the findings.")
    ] = OutputFormat.TEXT,
    fix: Annotated[bool, typer.Option("--fix", help="Apply the fixes that are safe.")] = False,
    no_env: Annotated[
        bool, typer.Option("--no-env", help="Do not report unset environment variables.")
    ] = False,
    explain: Annotated[
        str | None,
        typer.Option("--explain", help="Print the page of a rule, or `all` rules.", metavar="RULE"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print findings only.")] = False,
) -> None:
    """Check job manifests, adapter files and .msg files without opening any recording.

    Exit codes: 0 no findings, 1 a file cannot be read or written, 2 usage, 3 no file to check, 10 infos,
    11 warnings, 12 errors. With --format sarif, findings exit with 0.
    """
    from mosaico_ingest.cli.process import collect_garbage_as_usual
    from mosaico_ingest.lint.engine import STDIN, lint_paths
    from mosaico_ingest.lint.formats import FORMATS

    collect_garbage_as_usual()
    if explain is not None:
        typer.echo(_explanation(explain), nl=False)
        return
    if not paths:
        raise typer.BadParameter("give a file or a folder", param_hint="FILE|DIR|-")
    missing = [path for path in paths if path != STDIN and not Path(path).exists()]
    if missing:
        raise typer.BadParameter(f"{missing[0]} does not exist", param_hint="FILE|DIR|-")
    stdin = sys.stdin.read() if STDIN in paths else None
    report = lint_paths(paths, env=None if no_env else os.environ, fix=fix, stdin=stdin)
    if output_format is OutputFormat.TEXT:
        _print_text(report, quiet=quiet)
    else:
        typer.echo(FORMATS[output_format.value](report), nl=False)
    if report.exit_code and (output_format is not OutputFormat.SARIF or not report.files):
        raise typer.Exit(report.exit_code)


def _print_text(report: LintReport, *, quiet: bool) -> None:
    from mosaico_ingest.cli.console import Terminal, print_line, read_sources, render_findings

    if report.findings:
        # The texts of the report are those after fixes, and that of standard input.
        sources = {**read_sources(report.findings), **{file.file: file.text for file in report.files}}
        Terminal(soft_wrap=True).print(render_findings(report.findings, sources))
    if not quiet:
        for line in _summary(report).splitlines():
            print_line(line, style="bold", stderr=True)


def _summary(report: LintReport) -> str:
    """Return the number of files, findings and applied fixes, and a line about skipped files."""
    from mosaico_ingest.findings import join_names
    from mosaico_ingest.report.units import counted

    summary = "nothing to check: no manifest, adapter or .msg file"
    if report.files:
        summary = f"{counted(len(report.files), 'file')}, {counted(len(report.findings), 'finding')}"
    fixes = sum(file.fixed for file in report.files)
    if fixes:
        summary += f", {counted(fixes, 'change')} made"
    if report.skipped:
        names = join_names(skipped.file for skipped in report.skipped)
        skipped = counted(len(report.skipped), "file")
        summary += f"\n{skipped} skipped (not a manifest or an adapter): {names}"
    return summary


def _explanation(name: str) -> str:
    from mosaico_ingest.findings import nearest
    from mosaico_ingest.lint.pages import page_of, rule_index
    from mosaico_ingest.rules import RULES, find_rule

    if name == "all":
        return rule_index()
    rule = find_rule(name)
    if rule is None:
        close = nearest(name, RULES)
        hint = f"; did you mean {close!r}?" if close else "; list the rules with `--explain all`"
        raise typer.BadParameter(f"there is no rule {name!r}{hint}", param_hint="--explain")
    return page_of(rule)
