"""`ingest check`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from mosaico_ingest.cli.console import Terminal, print_json, print_line, read_sources, render_findings
from mosaico_ingest.cli.options import DEFAULT_STORE, JsonOption, JunitOption, SarifOption, write_output
from mosaico_ingest.report.units import counted

if TYPE_CHECKING:
    from mosaico_ingest.report.contract import ContractResult
    from mosaico_ingest.services.check import Checked


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
    from mosaico_ingest.pipeline.contract_check import needs_times_only
    from mosaico_ingest.report.files import gravest

    collect_garbage_as_usual()
    if expect is None and store is not None:
        raise typer.BadParameter("--store needs --expect FILE", param_hint="--store")
    checked: list[Checked] = []
    jobs = api.compile_job(Path(target)) if expect is None else ()
    if not (jobs and all(map(needs_times_only, jobs))):
        hide_pandas(jobs)
    results = (
        api.check_recordings(Path(target), jobs=jobs)
        if expect is None
        else [api.check_sequence(store or DEFAULT_STORE, target, expect)]
    )
    for one in results:
        checked.append(one)
        if not as_json:
            _print(one, show_all=show_all)
    if as_json:
        print_json([_document(one) for one in checked])
    if junit is not None or sarif is not None:
        _write_ci_files(checked, junit, sarif)
    if metrics is not None:
        from mosaico_ingest.report.metrics import contract_metrics

        write_output(metrics, contract_metrics([one.contract for one in checked if one.contract is not None]))
    code = gravest([one.exit_code for one in checked])
    if code:
        raise typer.Exit(code)


def _write_ci_files(checked: Sequence[Checked], junit: Path | None, sarif: Path | None) -> None:
    from mosaico_ingest.cli.ci import (  # the formats of lint take 30 ms to import
        CheckedRecording,
        write_ci_files,
    )

    recordings = [
        CheckedRecording(one.name, one.contract, None if one.error is None else str(one.error), one.findings)
        for one in checked
    ]
    write_ci_files(recordings, junit=junit, sarif=sarif)


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
    print_line(_summary(one.name, one.contract), style="green" if one.contract.passed else "bold red")


def _summary(name: str, contract: ContractResult) -> str:
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
