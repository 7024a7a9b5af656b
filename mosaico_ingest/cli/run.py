"""`ingest run`, `bag` and `replay`."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ParamSpec, TypeVar

import typer

from mosaico_ingest.cli.logs import JsonLines, LogFormat, LogOption, set_up_logging
from mosaico_ingest.cli.process import collect_as_usual, interrupt_on_terminate
from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.report.events import BatchObserver, Event, RunFinished, ignore_batch

if TYPE_CHECKING:
    from mosaico_ingest.executors.in_process import Executor
    from mosaico_ingest.findings import Finding
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.report.model import RunReport, UsedManifest

__all__ = [
    "bag",
    "replay",
    "run",
    "run_configs",
    "take_shard",
    "telemetry",
]

T = TypeVar("T")


def take_shard(items: Sequence[T], shard: str) -> list[T]:
    """Return every n-th item from the i-th on, for a shard written `i/n` with i from 1.

    Raises:
        ManifestError: It is written otherwise.
    """
    first, _, count = shard.partition("/")
    if not (first.isdecimal() and count.isdecimal() and 1 <= int(first) <= int(count)):
        raise ManifestError(
            f"--shard is {shard!r}", hint="write the shard and how many there are, as 1/8 .. 8/8"
        )
    return list(items[int(first) - 1 :: int(count)])


@contextmanager
def telemetry(wanted: bool) -> Generator[BatchObserver]:
    """Yield the observer that sends metrics and traces, each unless the environment says `none`.

    Raises:
        IngestError: OpenTelemetry is not installed.
    """
    if not wanted:
        yield ignore_batch
        return
    from mosaico_ingest.report.telemetry import Telemetry

    sender = Telemetry(metrics=_is_on("OTEL_METRICS_EXPORTER"), traces=_is_on("OTEL_TRACES_EXPORTER"))
    try:
        yield sender
    finally:
        sender.close()


def _is_on(variable: str) -> bool:
    return os.environ.get(variable, "") != "none"


P = ParamSpec("P")


def run_configs(
    configs: Sequence[ROSInjectionConfig],
    *,
    report: Path | None,
    quiet: bool,
    log: str | None,
    jobs: int | None = None,
    executor: Executor | None = None,
    log_format: LogFormat = LogFormat.TEXT,
    manifests: Sequence[UsedManifest] = (),
    watching: BatchObserver = ignore_batch,
    finished: Callable[[RunReport], None] = lambda _result: None,
) -> None:
    """Run the configurations, several at a time where asked for; exit with the report's code unless it is 0."""
    from mosaico_ingest import api
    from mosaico_ingest.report.model import write_report
    from mosaico_ingest.textfile import check_file

    level = log or (configs[0].log_level if configs else "INFO")
    prepare = partial(set_up_logging, level, log_format)
    prepare()
    interrupt_on_terminate()
    collect_as_usual()
    failures: list[RunFinished] = []
    targets = {path for path in (report, *map(_report_path, configs)) if path is not None}
    for target in targets:
        check_file(target)

    def tell(position: int, event: Event) -> None:
        if isinstance(event, RunFinished) and event.error is not None:
            failures.append(event)
        watching(position, event)
        observe(position, event)

    as_json = log_format is LogFormat.JSON
    with _display(configs, as_json=as_json, quiet=quiet) as observe:
        chosen = executor or _executor(configs, jobs, prepare)
        result = api.run(configs, executor=chosen, observe=tell, manifests=manifests)
    unwritten = [
        *_refusal(finished, result),
        *(one for target in targets for one in _refusal(write_report, result, target)),
    ]
    if not quiet and not as_json:
        from mosaico_ingest.cli.report import print_report

        print_report(result)
    errors = [] if as_json else [(failure.error or "", failure.findings) for failure in failures]
    errors += [(str(error), error.findings) for error in unwritten]
    if errors:
        _print_errors(errors)
    code = SinkError.exit_code if unwritten and result.exit_code in {0, 4} else result.exit_code
    if code:
        raise typer.Exit(code)


def _display(
    configs: Sequence[ROSInjectionConfig], *, as_json: bool, quiet: bool
) -> AbstractContextManager[BatchObserver]:
    """Return what shows the run while it goes; what draws is slow to import, and only people want it drawn."""
    if quiet and not as_json:
        return nullcontext(ignore_batch)
    from mosaico_ingest.cli.progress import Tally, display, sizes_of

    tally = Tally(sizes_of(configs) if len(configs) > 1 else [1] * len(configs))
    if as_json:
        return nullcontext(JsonLines(tally))
    return display(tally)


def _refusal(write: Callable[P, None], *given: P.args, **named: P.kwargs) -> Iterator[SinkError]:
    """Yield what keeps a file from being written: it costs that file, not what else there is to say of the run."""
    try:
        write(*given, **named)
    except SinkError as error:
        yield error


def _print_errors(errors: Iterable[tuple[str, Sequence[Finding]]]) -> None:
    from mosaico_ingest.cli.console import print_error

    for error, findings in errors:
        print_error(error, findings)


def _executor(
    configs: Sequence[ROSInjectionConfig], jobs: int | None, prepare: Callable[[], None]
) -> Executor:
    wanted = min(jobs or configs[0].jobs, len(configs)) if configs else 1
    if wanted == 1:
        from mosaico_ingest.executors.in_process import Inline

        return Inline()
    from mosaico_ingest.executors.processes import Processes

    return Processes(wanted, prepare=prepare)


def _report_path(config: ROSInjectionConfig) -> Path | None:
    return None if config.report_path is None else Path(config.report_path)


def bag(
    path: Annotated[
        str, typer.Argument(metavar="BAG", help="A .bag, .db3 or .mcap file, a rosbag2 directory, or a URL.")
    ],
    *,
    name: Annotated[str, typer.Option("--name", "-n", help="Name of the sequence.")],
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", "-t", help="Topic pattern, as /cam/*; !/cam/debug* takes away. Repeatable."),
    ] = None,
    more_topics: Annotated[
        list[str] | None, typer.Argument(metavar="TOPIC", help="More patterns, after --topics.")
    ] = None,
    metadata: Annotated[
        str | None,
        typer.Option("--metadata", help="A JSON object, or the file that holds one.", metavar="JSON|FILE"),
    ] = None,
    ros_distro: Annotated[
        str | None, typer.Option("--ros-distro", help="As ros2_humble; for recordings without definitions.")
    ] = None,
    host: Annotated[str | None, typer.Option("--host", help="A Mosaico server instead of the store.")] = None,
    port: Annotated[int, typer.Option("--port", help="The server's port.")] = 6726,
    api_key: Annotated[
        str | None,
        typer.Option("--api-key", envvar="MOSAICO_API_KEY", help="Its API key.", show_envvar=True),
    ] = None,
    tls_cert: Annotated[
        Path | None,
        typer.Option("--tls-cert", metavar="FILE", help="CA certificate the server is checked against, PEM."),
    ] = None,
    store: Annotated[
        str | None,
        typer.Option("--store", help="The store to write to.", metavar="DIR|URL", show_default="mosaico"),
    ] = None,
    if_exists: Annotated[
        IfExists,
        typer.Option("--if-exists", help="Where the sequence is there; skip needs the same content."),
    ] = IfExists.FAIL,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="FILE", help="Write the report as JSON.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: Annotated[
        str | None,
        typer.Option(
            "--log",
            "-l",
            help="DEBUG, INFO, WARNING, ERROR or CRITICAL.",
            metavar="LEVEL",
            show_default="INFO",
        ),
    ] = None,
) -> None:
    """Ingest one recording, without a manifest."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.process import forgo_pandas

    config = api.quick_config(
        path,
        sequence_name=name,
        topics=[*(topics or ()), *(more_topics or ())],
        metadata=metadata,
        ros_distro=ros_distro,
        host=host,
        port=port,
        api_key=api_key,
        tls_cert_path=tls_cert,
        store=store,
        if_exists=if_exists,
    )
    forgo_pandas([config])
    run_configs([config], report=report, quiet=quiet, log=log)


_DONE = {0, 4}
"""Exit codes of runs that took what could be taken."""
_SAYS = {
    "STORED": "its messages are in the sequence already",
    "FORGOTTEN": "the run that kept it is not part of its sequence; ingest the recording for what it holds",
}


def replay(
    folder: Annotated[
        Path, typer.Argument(metavar="QUARANTINE", help="The folder rejected messages lie in.")
    ],
    manifest: Annotated[
        Path, typer.Option("--manifest", "-m", help="The mended manifest of the job.", metavar="JOB.yaml")
    ],
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the report of this call as JSON.", metavar="FILE")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
    log: LogOption = None,
) -> None:
    """Add quarantined messages to the sequences they belong to; what fails again stays in the quarantine."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.services.replay import Whereabouts, alone, replays

    def mark(result: RunReport) -> None:
        for replay, recording in zip(waiting, result.recordings, strict=False):
            if recording.exit_code in _DONE:
                replay.kept.mark_replayed()

    configs = api.compile_job(manifest)
    with alone(folder):
        found = replays(folder, configs)
        for replay in found:
            if replay.whereabouts is Whereabouts.STORED:
                replay.kept.mark_replayed()
            if replay.whereabouts is not Whereabouts.WAITING and not quiet:
                print_line(f"{replay.kept.messages.name}: {_SAYS[replay.whereabouts.name]}", stderr=True)
        waiting = [replay for replay in found if replay.whereabouts is Whereabouts.WAITING]
        if all(replay.whereabouts is Whereabouts.FORGOTTEN for replay in found):
            raise NothingMatched("there is nothing to replay", where=str(folder), hint=_SAYS["FORGOTTEN"])
        run_configs(
            [replay.config for replay in waiting], report=report, quiet=quiet, log=log, jobs=1, finished=mark
        )


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
    from mosaico_ingest.cli.process import forgo_pandas
    from mosaico_ingest.report.metrics import prometheus_text
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
