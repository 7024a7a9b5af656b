"""This file is `ingest plan`: what a job would do, as a table, as a file, or against an earlier one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["plan"]


def plan(
    manifest: Annotated[Path, typer.Argument(metavar="JOB.yaml", help="A job manifest.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the plan as JSON, for `run --plan`.", metavar="FILE")
    ] = None,
    check: Annotated[
        Path | None, typer.Option("--check", help="Fail where the plan is not that of FILE.", metavar="FILE")
    ] = None,
    connect: Annotated[bool, typer.Option("--connect", help="Ask the server, if the target is one.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Decide everything against the real recording and try a few messages of each topic; write nothing.

    Exit codes: 0 the job can run, 1 it cannot or has drifted, 3 nothing matches, 4 messages would be rejected.
    """
    from mosaico_ingest import api
    from mosaico_ingest.cli.collector import collect_as_usual
    from mosaico_ingest.cli.plan_tables import print_differences, print_plan
    from mosaico_ingest.cli.tables import print_json
    from mosaico_ingest.cli.without_pandas import forgo_pandas
    from mosaico_ingest.plan.document import write_plan

    collect_as_usual()
    configs = api.compile_job(manifest)
    forgo_pandas(configs)
    document = api.plan_job(manifest, configs=configs, folder=out.parent if out else None, connect=connect)
    if out is not None:
        write_plan(document, out)
    if as_json:
        print_json(document.model_dump_json(indent=2))
    elif check is None:
        print_plan(document, folder=manifest.parent)
    if check is not None:
        drift = api.plan_differences(check, document)
        if not as_json:
            print_differences(drift)
        code = 1 if drift else 0
    else:
        code = document.exit_code
    if code:
        raise typer.Exit(code)
