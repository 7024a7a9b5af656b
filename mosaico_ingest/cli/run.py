"""`ingest run`, `bag` and `replay`, and the function that runs tasks for all three."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from enum import Enum
from functools import partial
from operator import methodcaller
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from msgspec import Struct, field

from mosaico_ingest.cli.options import (
    STANDARD_OUTPUT,
    STORE,
    ApiKeyOption,
    DistroOption,
    JunitOption,
    LogOption,
    QuietOption,
    RecordingArgument,
    ReportOption,
    SarifOption,
    TlsCertOption,
    TopicsOption,
    VerifyOption,
    log_level,
    write_output,
)
from mosaico_ingest.cli.process import (
    LogFormat,
    collect_garbage_as_usual,
    hide_pandas,
    interrupt_on_sigterm,
    set_up_logging,
    set_up_worker,
    uses_python_adapters,
)
from mosaico_ingest.errors import IngestError, ManifestError, SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.lazy import LazySequence, concatenate
from mosaico_ingest.report.events import SUCCESSFUL, BatchObserver, Event, RunFinished, ignore_batch

if TYPE_CHECKING:
    from mosaico_ingest.executors import Executor
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.pipeline.task import Task
    from mosaico_ingest.report.run import RunReport, UsedManifest

T = TypeVar("T")

MAX_ERRORS = 100
"""Errors printed for a batch."""
MAX_REPORTS = 1000
"""Recordings above which their reports are kept in a file instead of in memory."""
REPLAY_NOTES = {
    "STORED": "its messages are already in the sequence",
    "ORPHANED": "the sequence does not contain the run that quarantined it; ingest the recording again",
}
"""Why a file of quarantined messages is not replayed."""


class ExecutorName(str, Enum):
    """Where recordings are ingested."""

    LOCAL = "local"
    RAY = "ray"


class _ResultFiles(Struct, frozen=True):
    """The files of `--metrics`, `--junit` and `--sarif`."""

    metrics: Path | None
    junit: Path | None
    sarif: Path | None

    def check(self) -> None:
        """Raise ManifestError if one of the paths is a folder."""
        from mosaico_ingest.documents import check_output_file

        for file in (self.metrics, self.junit, self.sarif):
            if file is not None and file != STANDARD_OUTPUT:
                check_output_file(file)

    def write(self, report: RunReport) -> None:
        """Write the files."""
        from mosaico_ingest.report.summaries import prometheus_text

        if self.metrics is not None:
            write_output(self.metrics, prometheus_text(report))
        if self.junit is not None or self.sarif is not None:
            from mosaico_ingest.cli.check import CiFiles, run_outcome

            with CiFiles(self.junit, self.sarif) as files:
                for recording in report.recordings:
                    files.add(run_outcome(recording))


def run(
    manifests: Annotated[
        list[Path] | None, typer.Argument(metavar="JOB.yaml", help="Job manifests, run in this order.")
    ] = None,
    *,
    plan: Annotated[
        Path | None,
        typer.Option(
            "--plan", help="Run this plan; fail if manifest or recordings have changed.", metavar="FILE"
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            min=1,
            max=1024,
            metavar="N",
            help="Recordings ingested in parallel; overrides run.jobs.",
        ),
    ] = None,
    executor: Annotated[
        ExecutorName, typer.Option("--executor", help="Ingest on this machine, or on a Ray cluster.")
    ] = ExecutorName.LOCAL,
    address: Annotated[
        str | None,
        typer.Option(
            "--address",
            help="Address of the Ray cluster: auto or HOST:PORT. If omitted, Ray starts on this machine.",
            metavar="ADDRESS",
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(
            "--shard", metavar="I/N", help="Ingest only the I-th of N equal shares of the recordings."
        ),
    ] = None,
    report: ReportOption = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the report of an interrupted run (FILE.jsonl): skip its stored recordings, and run the others.",
        ),
    ] = False,
    metrics: Annotated[
        Path | None,
        typer.Option(
            "--metrics",
            help="Write totals for the textfile collector of Prometheus; - writes them to stdout.",
            metavar="FILE",
        ),
    ] = None,
    junit: JunitOption = None,
    sarif: SarifOption = None,
    otel: Annotated[
        bool, typer.Option("--otel", help="Send metrics and traces, as configured by the OTEL_... variables.")
    ] = False,
    verify: VerifyOption = False,
    quiet: QuietOption = False,
    log: LogOption = None,
    log_format: Annotated[
        LogFormat, typer.Option("--log-format", help="Write progress and log records as text or JSON lines.")
    ] = LogFormat.TEXT,
) -> None:
    """Ingest the recordings of job manifests, or exactly the decisions of a plan."""
    from mosaico_ingest import api
    from mosaico_ingest.display import counted
    from mosaico_ingest.executors import choose_executor
    from mosaico_ingest.pipeline.task import Task

    if bool(manifests) == (plan is not None):
        raise typer.BadParameter("give manifests, or a plan with --plan", param_hint="JOB.yaml")
    if address is not None and executor is not ExecutorName.RAY:
        raise typer.BadParameter("needs --executor ray", param_hint="--address")
    tasks = concatenate([api.compile_job(manifest).map(Task) for manifest in manifests or ()])
    used_manifests = [api.used_manifest(manifest) for manifest in manifests or ()]
    if plan is not None:
        tasks = LazySequence.of(api.compile_plan(plan))
        sources = sorted({task.job.origin.file for task in tasks if task.job.origin.file})
        used_manifests = [api.used_manifest(Path(source)) for source in sources]
    if shard is not None:
        total, tasks = len(tasks), take_shard(tasks, shard)
        if not tasks and not quiet and log_format is LogFormat.TEXT:
            from mosaico_ingest.cli.console import print_line

            print_line(f"shard {shard} is empty: the job has {counted(total, 'recording')}", stderr=True)
    files = _ResultFiles(metrics, junit, sarif)
    files.check()

    on_ray = None
    if executor is ExecutorName.RAY:
        on_ray = choose_executor(tasks, simultaneous=jobs, ray=True, address=address)
    hide_pandas(tasks.map(_job_of))
    with send_telemetry(otel) as telemetry:
        run_tasks(
            tasks,
            report=report,
            quiet=quiet,
            log=log,
            jobs=jobs,
            executor=on_ray,
            log_format=log_format,
            manifests=used_manifests,
            observe=telemetry,
            on_finish=files.write,
            verify=verify,
            resume=resume,
        )


def bag(
    path: RecordingArgument,
    *,
    name: Annotated[
        str | None,
        typer.Option(
            "--name", "-n", metavar="NAME", help="Name of the sequence.", show_default="the file's stem"
        ),
    ] = None,
    topics: TopicsOption = None,
    more_topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="TOPIC", help="More topics, added after the topics of --topics."),
    ] = None,
    metadata: Annotated[
        str | None,
        typer.Option(
            "--metadata", help="Metadata of the sequence: a JSON object, or a JSON file.", metavar="JSON|FILE"
        ),
    ] = None,
    topic_metadata: Annotated[
        str | None,
        typer.Option(
            "--topic-metadata",
            help="Metadata by topic: a JSON object of objects, or a JSON file.",
            metavar="JSON|FILE",
        ),
    ] = None,
    ros_distro: DistroOption = None,
    host: Annotated[
        str | None,
        typer.Option(
            "--host", metavar="HOST", help="Host of a Mosaico server to write to, instead of the store."
        ),
    ] = None,
    port: Annotated[int, typer.Option("--port", metavar="PORT", help="Port of the server.")] = 6726,
    api_key: ApiKeyOption = None,
    tls_cert: TlsCertOption = None,
    store: Annotated[str | None, STORE] = None,
    if_exists: Annotated[
        IfExists,
        typer.Option("--if-exists", help="Action if the sequence exists; skip needs the same content."),
    ] = IfExists.FAIL,
    update_if_exists: Annotated[
        bool,
        typer.Option(
            "--update-if-exists", help="Add topics to an existing sequence, as --if-exists append does."
        ),
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan, without writing or connecting to a server.")
    ] = False,
    report: ReportOption = None,
    quiet: QuietOption = False,
    log: Annotated[str | None, log_level("INFO")] = None,
) -> None:
    """Ingest one recording without a manifest."""
    from mosaico_ingest import api
    from mosaico_ingest.pipeline.task import Task

    job = api.quick_config(
        path,
        sequence_name=name,
        topic_metadata=topic_metadata,
        update_if_exists=update_if_exists,
        dry_run=dry_run,
        topics=[*(topics or ()), *(more_topics or ())],
        metadata=metadata,
        ros_distro=ros_distro,
        host=host,
        port=port,
        api_key=api_key,
        tls_cert_path=tls_cert,
        store=store,
        if_exists=if_exists,
    ).job
    hide_pandas([job])
    if dry_run:
        from mosaico_ingest.cli.plan import PlanTables

        tables = PlanTables(Path())
        for recording in api.plan_recordings(Path(), jobs=[job]):
            tables.add(recording)
        raise typer.Exit(tables.finish())
    run_tasks([Task(job)], report=report, quiet=quiet, log=log)


def replay(
    folder: Annotated[
        Path, typer.Argument(metavar="QUARANTINE", help="Quarantine folder with rejected messages.")
    ],
    manifest: Annotated[
        Path, typer.Option("--manifest", "-m", help="The fixed manifest of the job.", metavar="JOB.yaml")
    ],
    report: ReportOption = None,
    quiet: QuietOption = False,
    log: LogOption = None,
) -> None:
    """Add quarantined messages to their sequences; messages that are rejected again stay in the quarantine."""
    from mosaico_ingest import api
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.pipeline.task import Task
    from mosaico_ingest.services.status import ReplayState, find_replays, lock_quarantine

    def mark_replayed(result: RunReport) -> None:
        for entry, recording in zip(waiting, result.recordings, strict=False):
            if recording.exit_code in SUCCESSFUL:
                entry.file.mark_replayed()

    jobs = api.compile_job(manifest)
    with lock_quarantine(folder):
        entries = find_replays(folder, jobs)
        for entry in entries:
            if entry.state is ReplayState.STORED:
                entry.file.mark_replayed()
            if entry.state is not ReplayState.WAITING and not quiet:
                note = REPLAY_NOTES[entry.state.name]
                print_line(f"{entry.file.messages.name}: {note}", stderr=True)
        waiting = [entry for entry in entries if entry.state is ReplayState.WAITING]
        if all(entry.state is ReplayState.ORPHANED for entry in entries):
            raise NothingMatched(
                "no message can be replayed", where=str(folder), hint=REPLAY_NOTES["ORPHANED"]
            )
        run_tasks(
            [Task(entry.job) for entry in waiting],
            report=report,
            quiet=quiet,
            log=log,
            jobs=1,
            on_finish=mark_replayed,
        )


def run_tasks(
    tasks: Sequence[Task],
    *,
    report: Path | None,
    quiet: bool,
    log: str | None,
    jobs: int | None = None,
    executor: Executor | None = None,
    log_format: LogFormat = LogFormat.TEXT,
    manifests: Sequence[UsedManifest] = (),
    observe: BatchObserver = ignore_batch,
    on_finish: Callable[[RunReport], None] = lambda _report: None,
    verify: bool = False,
    resume: bool = False,
) -> None:
    """Run the tasks with a progress display, write reports, print the result, and exit with its code.

    `on_finish` receives the report after the run. If it or a report file cannot be written, the others still are.

    Raises:
        typer.Exit: The exit code is not 0.
    """
    from mosaico_ingest import api
    from mosaico_ingest.documents import check_output_file
    from mosaico_ingest.executors import choose_executor

    as_json = log_format is LogFormat.JSON
    level = log or ("ERROR" if quiet else tasks[0].job.run.log_level if tasks else "INFO")
    set_up_logging(level, log_format)
    batch = LazySequence.of(tasks)
    python_adapters = any(uses_python_adapters(task.job) for task in batch.samples)
    prepare = partial(set_up_worker, level, log_format, python_adapters=python_adapters)
    if log or quiet:
        batch = batch.map(methodcaller("with_log_level", level))
    interrupt_on_sigterm()
    collect_garbage_as_usual()
    paths = (report, *(_report_path(task.job) for task in batch.samples))
    report_files = list(dict.fromkeys(path for path in paths if path is not None))
    for file in report_files:
        if file != STANDARD_OUTPUT:
            check_output_file(file)
    errors = _Errors()

    def observe_all(position: int, event: Event) -> None:
        errors(event)
        observe(position, event)
        show(position, event)

    with _streamed_report(report_files, len(batch), resume=resume) as stream:
        with _display(batch, as_json=as_json, quiet=quiet) as show:
            result = api.run(
                batch,
                executor=executor or choose_executor(batch, simultaneous=jobs, prepare=prepare),
                observe=observe_all,
                manifests=manifests,
                verify=verify,
                report=stream,
                resume=resume,
            )
        write_errors = list(
            _write_results(result, [file for file in report_files if file != stream], on_finish)
        )
        if not quiet and not as_json:
            from mosaico_ingest.cli.report import print_report

            print_report(result, stderr=STANDARD_OUTPUT in report_files)
    if as_json:
        errors = _Errors()
    errors.print(write_errors)
    code = SinkError.exit_code if write_errors and result.exit_code in SUCCESSFUL else result.exit_code
    if code:
        raise typer.Exit(code)


class _Errors(Struct):
    """The errors of failed recordings."""

    first: list[RunFinished] = field(default_factory=list[RunFinished])
    """The first `MAX_ERRORS` of them."""
    count: int = 0

    def __call__(self, event: Event) -> None:
        """Add the error of a recording."""
        if isinstance(event, RunFinished) and event.error is not None:
            self.count += 1
            if self.count <= MAX_ERRORS:
                self.first.append(event)

    def print(self, others: Sequence[IngestError]) -> None:
        """Print these errors and others."""
        if not self.count and not others:
            return
        from mosaico_ingest.cli.console import print_error, print_line

        for failure in self.first:
            print_error(failure.error or "", failure.findings)
        if self.count > MAX_ERRORS:
            line = f"… and {self.count - MAX_ERRORS:,} more errors; --report FILE writes all of them"
            print_line(line, stderr=True)
        for error in others:
            print_error(str(error), error.findings)


@contextmanager
def _streamed_report(files: Sequence[Path], recordings: int, *, resume: bool) -> Generator[Path | None]:
    """Yield the file to which each recording is appended when it ends.

    It is the first report file in JSON Lines; without one, a temporary file if there are many recordings.

    Raises:
        typer.BadParameter: The report of an earlier run cannot be continued, because no report file is in JSON Lines.
    """
    from mosaico_ingest.report.run import LINES_SUFFIX

    report_file = next((file for file in files if file.suffix == LINES_SUFFIX), None)
    if resume and report_file is None:
        raise typer.BadParameter(
            f"needs a report in JSON Lines: --report FILE{LINES_SUFFIX}", param_hint="--resume"
        )
    if report_file is not None or recordings <= MAX_REPORTS:
        yield report_file
        return
    # On Windows, the folder of a file that is still open stays.
    with TemporaryDirectory(prefix="ingest-report-", ignore_cleanup_errors=True) as folder:
        yield Path(folder) / f"report{LINES_SUFFIX}"


def _display(
    tasks: LazySequence[Task], *, as_json: bool, quiet: bool
) -> AbstractContextManager[BatchObserver]:
    """Return the progress display. It is imported only if it is used, because rich is slow to import."""
    if quiet and not as_json:
        return nullcontext(ignore_batch)
    from mosaico_ingest.cli.progress import JsonLines, Tally, live_display, recording_sizes

    tally = Tally(recording_sizes(tasks.map(_job_of)) if len(tasks) > 1 else [1] * len(tasks))
    return nullcontext(JsonLines(tally)) if as_json else live_display(tally)


def _write_results(
    result: RunReport, report_files: Sequence[Path], on_finish: Callable[[RunReport], None]
) -> Iterator[SinkError]:
    """Call `on_finish` and write the report files; yield the errors."""
    from mosaico_ingest.report.run import report_text

    def write_report(file: Path) -> None:
        write_output(file, report_text(result, file))

    for write in (partial(on_finish, result), *(partial(write_report, file) for file in report_files)):
        try:
            write()
        except SinkError as error:  # noqa: PERF203 - a file that cannot be written must not affect the others
            yield error


def _job_of(task: Task) -> Job:
    return task.job


def _report_path(job: Job) -> Path | None:
    return None if job.run.report is None else Path(job.run.report)


def take_shard(items: LazySequence[T], shard: str) -> LazySequence[T]:
    """Return every N-th item, starting with the I-th, for a shard `I/N` with I from 1 to N.

    Raises:
        ManifestError: The shard has another form.
    """
    first, _, count = shard.partition("/")
    if not (first.isdecimal() and count.isdecimal() and 1 <= int(first) <= int(count)):
        raise ManifestError(
            f"--shard is {shard!r}", hint="write the number of the shard and of all shards, from 1/8 to 8/8"
        )
    return items[int(first) - 1 :: int(count)]


@contextmanager
def send_telemetry(enabled: bool) -> Generator[BatchObserver]:
    """Yield the observer that sends metrics and traces, except those whose exporter variable is `none`.

    Raises:
        IngestError: OpenTelemetry is not installed.
    """
    if not enabled:
        yield ignore_batch
        return
    from mosaico_ingest.report.telemetry import Telemetry

    telemetry = Telemetry(
        metrics=os.environ.get("OTEL_METRICS_EXPORTER") != "none",
        traces=os.environ.get("OTEL_TRACES_EXPORTER") != "none",
    )
    try:
        yield telemetry
    finally:
        telemetry.close()
