"""This file is `ingest run`: jobs from their manifests."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["run"]


def run(
    manifests: Annotated[
        list[Path] | None, typer.Argument(metavar="JOB.yaml...", help="Job manifests, run in order.")
    ] = None,
    *,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", help="Run exactly this plan, or nothing where it no longer fits.", metavar="FILE"
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", "-j", min=1, max=1024, help="Recordings ingested at a time; overrides run.jobs."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the report of this call as JSON.", metavar="FILE")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: Annotated[
        str | None, typer.Option("--log", help="Log level; overrides run.log_level.", metavar="LEVEL")
    ] = None,
) -> None:
    """Ingest what the manifests name."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.session import run_configs

    if bool(manifests) == (plan is not None):
        raise typer.BadParameter("name manifests, or a plan with --plan", param_hint="JOB.yaml")
    configs = [config for manifest in manifests or () for config in api.compile_job(manifest)]
    if plan is not None:
        configs += api.compile_plan(plan)
    run_configs(configs, report=report, quiet=quiet, log=log, jobs=jobs)
