"""`ingest watch` and `status`."""

from __future__ import annotations

import time
from collections import Counter
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.options import JsonOption, VerifyOption, log_level

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.remote import AnyPath
    from mosaico_ingest.report.model import Report
    from mosaico_ingest.services.status import RecordingStatus
    from mosaico_ingest.services.watch import Arrivals

EXIT_UNFINISHED = 4
"""Exit code of `watch --once` if a recording was not ingested because its end is missing."""
STATUS_STYLES = {"done": "green", "new": "cyan", "changed": "yellow", "failed": "red", "unreadable": "red"}


def status(
    manifests: Annotated[list[Path], typer.Argument(metavar="JOB.yaml", help="Job manifests.")],
    *,
    check: Annotated[
        bool, typer.Option("--check", help="Exit with 1 unless every recording is done.")
    ] = False,
    verify: VerifyOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show the status of each recording: done, new, changed, failed or unreadable. Read-only."""
    from msgspec import to_builtins

    from mosaico_ingest import api
    from mosaico_ingest.cli.console import print_json

    recordings = [
        recording for manifest in manifests for recording in api.job_status(manifest, verify=verify)
    ]
    if as_json:
        print_json([to_builtins(recording) for recording in recordings])
    else:
        _print_status(recordings)
    if check and any(recording.status.value != "done" for recording in recordings):
        raise typer.Exit(1)


def _print_status(recordings: list[RecordingStatus]) -> None:
    from rich.text import Text

    from mosaico_ingest.cli.console import PlainTable, Terminal, print_line

    table = PlainTable("sequence", "status", "recording")
    for recording in recordings:
        status = recording.status.value
        files = ", ".join(recording.files)
        reason = recording.reason.removeprefix(f"{files}: ")  # an error already starts with its location
        table.add_row(
            recording.sequence,
            Text(status, style=STATUS_STYLES[status]),
            f"{files}: {reason}" if reason else files,
        )
    Terminal().print(table)
    counts = Counter(recording.status.value for recording in recordings)
    print_line(", ".join(f"{count} {status}" for status, count in counts.items()))


def watch(
    folder: Annotated[
        str,
        typer.Argument(metavar="DIR", help="Folder or URL (s3://, gs://, az://) in which recordings arrive."),
    ],
    manifest: Annotated[
        Path,
        typer.Argument(metavar="JOB.yaml", help="Job manifest for each recording; bag.path is not used."),
    ],
    *,
    rest: Annotated[
        float,
        typer.Option(
            "--rest",
            min=0.0,
            metavar="SECONDS",
            help="Time without a change after which a recording is complete.",
        ),
    ] = 10.0,
    unfinished_rest: Annotated[
        float,
        typer.Option(
            "--unfinished-rest",
            min=0.0,
            metavar="SECONDS",
            help="Time without a change after which a recording without its end is ingested; it may still be written, or its recorder crashed.",
        ),
    ] = 600.0,
    every: Annotated[
        float,
        typer.Option("--every", min=0.05, metavar="SECONDS", help="Time between two checks of the folder."),
    ] = 2.0,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=1, metavar="N", help="Recordings ingested in parallel.")
    ] = 1,
    once: Annotated[
        bool,
        typer.Option(
            "--once",
            help="Ingest the complete recordings, then exit like a run; with 4 if a recording is unfinished.",
        ),
    ] = False,
    log: Annotated[str, log_level()] = "WARNING",
) -> None:
    """Ingest recordings that arrive in a folder or behind a URL, until interrupted.

    Sequences that are already stored with the same content are skipped.
    """
    from mosaico_ingest.cli.logs import set_up_logging
    from mosaico_ingest.cli.process import collect_garbage_as_usual, interrupt_on_sigterm
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.remote import as_path, with_network
    from mosaico_ingest.report.files import gravest
    from mosaico_ingest.services.watch import Arrivals

    set_up_logging(log)
    interrupt_on_sigterm()
    collect_garbage_as_usual()
    jobs_of_manifest = load_manifests(manifest)  # report mistakes now, not with the first recording
    watched = with_network(as_path(folder), jobs_of_manifest[0].manifest.network.limits)
    if isinstance(watched, Path) and not watched.is_dir():
        raise typer.BadParameter(f"{folder} is not a folder", param_hint="DIR")
    arrivals = Arrivals(watched, rest, max(rest, unfinished_rest))
    _print(f"watching {watched}")
    codes: list[int] = []
    deadline = time.monotonic() + rest + every if once else float("inf")
    try:
        while True:
            complete = _settled(arrivals)
            if complete and not _ingest(manifest, complete, jobs, arrivals, codes, once=once):
                break
            if not complete and time.monotonic() > deadline:
                break
            time.sleep(every)
    except KeyboardInterrupt:
        pass
    for path in arrivals.unfinished() if once else ():
        _print(f"{path}: not ingested: the end of the recording is missing, it may still be written")
        codes.append(EXIT_UNFINISHED)
    _print("stopped watching")
    code = gravest(codes) if once else 0
    if code:
        raise typer.Exit(code)


def _settled(arrivals: Arrivals) -> tuple[AnyPath, ...]:
    """Return the recordings that became complete; print the reason if the folder cannot be listed at the moment."""
    from mosaico_ingest.errors import Unreachable

    try:
        return arrivals.settled(time.monotonic())
    except Unreachable as error:
        _print(f"{error}; trying again")
        return ()


def _ingest(
    manifest: Path, paths: tuple[AnyPath, ...], jobs: int, arrivals: Arrivals, codes: list[int], *, once: bool
) -> bool:
    """Ingest recordings, print a line about each, and add its exit code to `codes`.

    Unless the watch runs once, schedule another attempt of a recording that failed. A group consists of all complete
    recordings of the folder. Return False if the run was interrupted.
    """
    from mosaico_ingest.executors.processes import Processes
    from mosaico_ingest.pipeline.contract_check import add_group_results
    from mosaico_ingest.pipeline.task import Task
    from mosaico_ingest.report.events import RunStatus, ignore_batch

    def others() -> list[Job]:
        present = (path for path in arrivals.complete() if path not in paths)
        return [job for path in present for job in _jobs(manifest, path, None, [])]

    retries = None if once else arrivals
    work = [(path, job) for path in paths for job in _jobs(manifest, path, retries, codes)]
    tasks = add_group_results([Task(job) for _, job in work], others)
    # Even a single recording runs in a worker process, so that a crash does not end the watch.
    reports = Processes(jobs).map(tasks, ignore_batch)
    interrupted = False
    for (path, _), report in zip(work, reports, strict=False):
        interrupted = interrupted or report.status is RunStatus.INTERRUPTED
        codes.append(report.exit_code)
        failed = report.exit_code not in {0, 4}
        retry = _retry_text(retries, path) if failed and not interrupted else ""
        _print(f"{path}: {_outcome_text(report)}{retry}")
    return not interrupted


def _jobs(manifest: Path, path: AnyPath, arrivals: Arrivals | None, codes: list[int]) -> tuple[Job, ...]:
    from mosaico_ingest import api
    from mosaico_ingest.errors import IngestError

    try:
        return api.compile_recording(manifest, path)
    except IngestError as error:
        codes.append(error.exit_code)
        _print(f"{path}: failed: {error}{_retry_text(arrivals, path)}")
        return ()


def _outcome_text(report: Report) -> str:
    from mosaico_ingest.report.units import count_text, counted, seconds_text

    outcome = f"{report.status.value} as {report.sequence}"
    if report.error is not None:
        return f"{outcome}: {report.error}"
    totals = report.totals
    rejected = f", {count_text(totals.rejected)} rejected" if totals.rejected else ""
    return f"{outcome}, {counted(totals.written, 'message')}{rejected}, {seconds_text(report.duration_s)}"


def _retry_text(arrivals: Arrivals | None, path: AnyPath) -> str:
    """Schedule another attempt, unless the watch runs once, and return when it is due."""
    return "" if arrivals is None else f"; next attempt in {arrivals.again(path, time.monotonic()):.0f} s"


def _print(line: str) -> None:
    from mosaico_ingest.cli.console import print_line

    print_line(f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ} {line}")
