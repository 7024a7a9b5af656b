"""`ingest check` and `lint`, and the results of `run`, `plan` and `check` as JUnit XML and SARIF."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec import Struct
from rich.text import Text
from typing_extensions import Self

from mosaico_ingest.cli.console import Terminal, print_line, read_sources, render_findings
from mosaico_ingest.cli.options import (
    DEFAULT_STORE,
    JsonOption,
    JunitOption,
    SarifOption,
    output_file,
    write_output,
)
from mosaico_ingest.display import counted
from mosaico_ingest.errors import IngestError, gravest
from mosaico_ingest.findings import Finding, Severity, join_names, nearest
from mosaico_ingest.lazy import LazySequence

if TYPE_CHECKING:
    from mosaico_ingest.lint.engine import LintReport
    from mosaico_ingest.lint.formats import Case, Suite
    from mosaico_ingest.report.parts import ContractResult, ExpectationResult
    from mosaico_ingest.report.recording import Report
    from mosaico_ingest.services.check import Checked

MAX_FINDINGS = 5000
"""Findings in a SARIF file; services show no more of one file."""


def check(
    target: Annotated[
        str,
        typer.Argument(
            metavar="JOB.yaml|SEQUENCE", help="A job manifest; with --expect, the name of a stored sequence."
        ),
    ],
    *,
    store: Annotated[
        str | None,
        typer.Option(
            "--store",
            help="With --expect: the folder or URL of the store.",
            metavar="DIR|URL",
            show_default=DEFAULT_STORE,
        ),
    ] = None,
    expect: Annotated[
        Path | None,
        typer.Option(
            "--expect",
            help="Check a stored sequence instead of recordings, against the section expect of this file.",
            metavar="FILE",
        ),
    ] = None,
    show_all: Annotated[
        bool, typer.Option("--all", "-a", help="Also print expectations that hold or are not evaluated.")
    ] = False,
    metrics: Annotated[
        Path | None,
        typer.Option(
            "--metrics",
            help="Write the number of expectations by outcome for the textfile collector of Prometheus.",
            metavar="FILE",
        ),
    ] = None,
    junit: JunitOption = None,
    sarif: SarifOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check recordings, or a stored sequence, against a data contract. Read-only.

    Exit codes: 0 the contract holds, 6 an expectation with the severity `error` failed, 1 a recording cannot be read,
    2 the manifest is wrong, 3 nothing matches.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas
    from mosaico_ingest.documents import JsonListWriter
    from mosaico_ingest.pipeline.contract_check import needs_times_only

    collect_garbage_as_usual()
    if expect is None and store is not None:
        raise typer.BadParameter("--store needs --expect FILE", param_hint="--store")
    jobs = api.compile_job(Path(target)) if expect is None else ()
    if not (jobs and all(map(needs_times_only, LazySequence.of(jobs).samples))):
        hide_pandas(jobs)
    results = (
        api.check_recordings(Path(target), jobs=jobs)
        if expect is None
        else [api.check_sequence(store or DEFAULT_STORE, target, expect)]
    )
    codes: set[int] = set()
    counts = None
    if metrics is not None:
        from mosaico_ingest.report.summaries import ContractCounts

        counts = ContractCounts()
    printed = JsonListWriter(sys.stdout.write, "[]")
    with CiFiles(junit, sarif) as ci:
        for one in results:
            codes.add(one.exit_code)
            if counts is not None and one.contract is not None:
                counts.add(one.contract)
            error = None if one.error is None else str(one.error)
            ci.add(CheckedRecording(one.name, one.contract, error, one.findings))
            if as_json:
                printed.add(json.dumps(_document(one), indent=2, ensure_ascii=False, default=str))
            else:
                _print(one, show_all=show_all)
        if as_json:
            printed.finish()
    if metrics is not None and counts is not None:
        write_output(metrics, counts.gauges())
    code = gravest(codes)
    if code:
        raise typer.Exit(code)


class CheckedRecording(Struct, frozen=True):
    """The outcome of one recording: the results of its contract, and the error that ended its run."""

    name: str
    """The name of the sequence or of the check."""
    contract: ContractResult | None = None
    error: str | None = None
    findings: tuple[Finding, ...] = ()
    """The findings of the error."""


class CiFiles:
    """The files of `--junit` and `--sarif`: test suites are written one by one, and findings are kept up to a limit.

    The files are also written if an `IngestError` ends the block.

    Raises:
        SinkError: A file cannot be written.
    """

    def __init__(self, junit: Path | None, sarif: Path | None) -> None:
        self._junit, self._sarif = junit, sarif
        self._files = ExitStack()
        self._write: Callable[[str], object] | None = None
        self._findings: dict[Finding, None] = {}
        self._more = 0

    def __enter__(self) -> Self:
        if self._junit is not None:
            from mosaico_ingest.lint.formats import JUNIT_START  # takes 30 ms to import

            self._write = self._files.enter_context(output_file(self._junit))
            self._write(JUNIT_START)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and not issubclass(kind, IngestError):
            self._files.__exit__(kind, error, trace)
            return
        if self._write is not None:
            from mosaico_ingest.lint.formats import JUNIT_END

            self._write(JUNIT_END)
        self._files.close()
        if self._sarif is not None:
            from mosaico_ingest.lint.formats import sarif_text

            write_output(self._sarif, sarif_text(tuple(self._findings)))
            if self._more:
                more = f"{self._sarif}: the first {MAX_FINDINGS:,} findings; {counted(self._more, 'more finding')}"
                print_line(more, style="yellow", stderr=True)

    def add(self, recording: CheckedRecording) -> None:
        """Add the outcome of a recording."""
        if self._write is not None:
            from mosaico_ingest.lint.formats import suite_text

            self._write(suite_text(_suite(recording)))
        if self._sarif is not None:
            for finding in _findings(recording):
                if len(self._findings) < MAX_FINDINGS:
                    self._findings[finding] = None
                else:
                    self._more += finding not in self._findings


def run_outcome(recording: Report) -> CheckedRecording:
    """Return the outcome of a recording of a run."""
    findings = tuple(each.finding for each in recording.error_findings)
    return CheckedRecording(recording.sequence, recording.contract, recording.error, findings)


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


def _print(one: Checked, *, show_all: bool) -> None:
    if one.contract is None:
        print_line(f"{one.name}: {one.error}", style="red")
        if len(one.findings) > 1:
            Terminal(soft_wrap=True).print(render_findings(one.findings, read_sources(one.findings)))
        return
    findings = [finding for result in one.contract.results if (finding := result.finding) is not None]
    selected = [finding for finding in findings if show_all or finding.rule != "expectation-skipped"]
    if show_all:
        for result in one.contract.results:
            if result.finding is None:
                Terminal(soft_wrap=True).print(
                    Text(f"passed: {result.expectation}: {result.line}", style="green")
                )
    if selected:
        Terminal(soft_wrap=True).print(render_findings(selected, read_sources(selected)))
        print_line("")
    print_line(
        _contract_summary(one.name, one.contract), style="green" if one.contract.passed else "bold red"
    )


def _contract_summary(name: str, contract: ContractResult) -> str:
    counts = Counter(result.outcome.value for result in contract.results)
    warnings = len(contract.warnings)
    parts = [f"{counts['passed']} passed"]
    if contract.errors:
        parts.append(f"{len(contract.errors)} failed")
    if warnings:
        parts.append(f"{counted(warnings, 'warning')}")
    if counts["skipped"]:
        parts.append(f"{counts['skipped']} not evaluated")
    return f"{name}: {counted(len(contract.results), 'expectation')}: {', '.join(parts)}"


def _document(one: Checked) -> dict[str, object]:
    contract = None if one.contract is None else one.contract.model_dump(mode="json")
    return {
        "sequence": one.name,
        "error": None if one.error is None else str(one.error),
        "contract": contract,
    }


def _suite(recording: CheckedRecording) -> Suite:
    """Return a test case for each expectation and each other finding; a recording without both is one test case."""
    from mosaico_ingest.lint.formats import Case, Suite

    results = recording.contract.results if recording.contract is not None else ()
    cases = [_case(result, recording.name) for result in results]
    cases += [
        Case(f"{finding.rule}: {finding.message}", recording.name, failure=finding, span=finding.span)
        for finding in _other_findings(recording)
    ]
    return Suite(recording.name, tuple(cases) or (Case("ingest", recording.name),))


def _case(result: ExpectationResult, recording: str) -> Case:
    from mosaico_ingest.lint.formats import Case
    from mosaico_ingest.report.parts import Outcome

    topic = f" {result.topic}" if result.topic and result.topic not in result.expectation else ""
    span = None if result.location is None else result.location.span
    failure = result.finding if result.outcome is Outcome.FAILED else None
    skipped = result.text if result.outcome is Outcome.SKIPPED else None
    return Case(f"{result.expectation}{topic}", recording, failure=failure, skipped=skipped, span=span)


def _findings(recording: CheckedRecording) -> Iterator[Finding]:
    results = recording.contract.results if recording.contract is not None else ()
    yield from (finding for result in results if (finding := result.finding) is not None)
    yield from _other_findings(recording)


def _other_findings(recording: CheckedRecording) -> Iterable[Finding]:
    """Return the findings of the error that are not results of the contract, or the error itself if it has none."""
    has_results = recording.contract is not None
    others = [one for one in recording.findings if not has_results or one.rule != "expectation-failed"]
    if others or recording.error is None or recording.findings:
        return others
    return [Finding("run-failed", Severity.ERROR, recording.error)]


def _print_text(report: LintReport, *, quiet: bool) -> None:
    if report.findings:
        # The texts of the report are those after fixes, and that of standard input.
        sources = {**read_sources(report.findings), **{file.file: file.text for file in report.files}}
        Terminal(soft_wrap=True).print(render_findings(report.findings, sources))
    if not quiet:
        for line in _lint_summary(report).splitlines():
            print_line(line, style="bold", stderr=True)


def _lint_summary(report: LintReport) -> str:
    """Return the number of files, findings and applied fixes, and a line about skipped files."""
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
    from mosaico_ingest.rules import RULES, find_rule, page_of, rule_index

    if name == "all":
        return rule_index()
    rule = find_rule(name)
    if rule is None:
        close = nearest(name, RULES)
        hint = f"; did you mean {close!r}?" if close else "; list the rules with `--explain all`"
        raise typer.BadParameter(f"there is no rule {name!r}{hint}", param_hint="--explain")
    return page_of(rule)
