"""This file is `ingest run`: jobs from their manifests."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.log_format import LogFormat, LogOption

if TYPE_CHECKING:
    from mosaico_ingest.executors.executor import Executor

__all__ = ["run"]


class Place(str, Enum):
    """Where recordings are ingested."""

    LOCAL = "local"
    RAY = "ray"


def run(
    manifests: Annotated[
        list[Path] | None, typer.Argument(metavar="JOB.yaml", help="Job manifests, run in order.")
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
    executor: Annotated[
        Place, typer.Option("--executor", help="Where recordings are ingested: on this machine, or on Ray.")
    ] = Place.LOCAL,
    address: Annotated[
        str | None,
        typer.Option(
            "--address",
            help="The Ray cluster, as auto or host:6379; without it Ray is started here.",
            metavar="ADDRESS",
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", help="Only this share of the recordings, as 1/8 .. 8/8."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the report of this call as JSON.", metavar="FILE")
    ] = None,
    metrics: Annotated[
        Path | None,
        typer.Option("--metrics", help="Write the sums for Prometheus' textfile collector.", metavar="FILE"),
    ] = None,
    otel: Annotated[
        bool, typer.Option("--otel", help="Send metrics and traces where the OTEL_... variables say.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: LogOption = None,
    log_format: Annotated[
        LogFormat, typer.Option("--log-format", help="What is said while it runs: for people, or JSON lines.")
    ] = LogFormat.TEXT,
) -> None:
    """Ingest what the manifests name."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.session import run_configs
    from mosaico_ingest.cli.shard import take_shard
    from mosaico_ingest.cli.telemetry import telemetry
    from mosaico_ingest.cli.without_pandas import forgo_pandas
    from mosaico_ingest.report.metrics import prometheus_text
    from mosaico_ingest.report.model import RunReport
    from mosaico_ingest.report.units import counted
    from mosaico_ingest.textfile import check_file, write_whole

    if bool(manifests) == (plan is not None):
        raise typer.BadParameter("name manifests, or a plan with --plan", param_hint="JOB.yaml")
    configs = [config for manifest in manifests or () for config in api.compile_job(manifest)]
    used = [api.used_manifest(manifest) for manifest in manifests or ()]
    if plan is not None:
        configs += api.compile_plan(plan)
        used = [api.used_manifest(Path(name)) for name in sorted({c.where for c in configs if c.where})]
    if shard is not None:
        every, configs = len(configs), take_shard(configs, shard)
        if not configs and not quiet and log_format is LogFormat.TEXT:
            typer.echo(f"shard {shard} has none of {counted(every, 'recording')}", err=True)
    if metrics is not None:
        check_file(metrics)
    if address is not None and executor is not Place.RAY:
        raise typer.BadParameter("is for --executor ray", param_hint="--address")

    def finish(result: RunReport) -> None:
        if metrics is not None:
            write_whole(metrics, prometheus_text(result))

    forgo_pandas(configs)
    with telemetry(otel) as watching:
        run_configs(
            configs,
            report=report,
            quiet=quiet,
            log=log,
            jobs=jobs,
            executor=_on_ray(address, jobs) if executor is Place.RAY else None,
            log_format=log_format,
            manifests=used,
            watching=watching,
            finished=finish,
        )


def _on_ray(address: str | None, jobs: int | None) -> Executor:
    from mosaico_ingest.executors.ray import Ray

    return Ray(address, jobs)
