"""Commands that run until they are interrupted: `ingest serve`, `browse` and `watch`; also `keys` and `status`."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mosaico_ingest.cli.options import (
    DEFAULT_STORE,
    JsonOption,
    VerifyOption,
    log_level,
)
from mosaico_ingest.errors import ManifestError

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.remote import AnyPath
    from mosaico_ingest.report.recording import Report
    from mosaico_ingest.services.status import RecordingStatus
    from mosaico_ingest.services.watch import Arrivals

DEFAULT_KEY_FILE = Path("api_keys.json")
LOOPBACK = {"127.0.0.1", "::1", "[::1]", "localhost"}
WILDCARDS = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "[::]": "[::1]"}  # noqa: S104 - not bound here
"""The addresses at which this machine reaches a server that listens on all addresses."""
GRACE_S = 0.5
"""Seconds that open calls get to finish at shutdown."""
keys_app = typer.Typer(no_args_is_help=True, help="Create and list the API keys of `ingest serve`.")
KeyFileOption = Annotated[
    Path, typer.Option("--api-keys", metavar="FILE", help="Key file, which contains hashes only.")
]
DEFAULT_PORT = 6780
EXIT_UNFINISHED = 4
"""Exit code of `watch --once` if a recording was not ingested because its end is missing."""
STATUS_STYLES = {"done": "green", "new": "cyan", "changed": "yellow", "failed": "red", "unreadable": "red"}


class Permission(str, Enum):
    """Permissions of a key; each includes the previous ones."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    MANAGE = "manage"


def serve(
    store: Annotated[Path, typer.Option("--store", metavar="DIR", help="Folder of the store.")] = Path(
        "mosaico"
    ),
    host: Annotated[str, typer.Option("--host", metavar="HOST", help="Address to listen on.")] = "127.0.0.1",
    *,
    port: Annotated[
        int,
        typer.Option("--port", min=0, max=65535, metavar="PORT", help="Port to listen on; 0 chooses one."),
    ] = 6726,
    api_keys: Annotated[
        Path | None,
        typer.Option(
            "--api-keys",
            metavar="FILE",
            help="Key file, see `ingest keys new`. If omitted, all is permitted.",
        ),
    ] = None,
    tls_cert: Annotated[
        Path | None,
        typer.Option("--tls-cert", metavar="FILE", help="Certificate of the server, in PEM format."),
    ] = None,
    tls_key: Annotated[
        Path | None,
        typer.Option("--tls-key", metavar="FILE", help="Private key of the certificate, in PEM format."),
    ] = None,
    idle_minutes: Annotated[
        float,
        typer.Option(
            "--idle-minutes",
            min=0.01,
            metavar="MINUTES",
            help="Discard sessions that are idle for this long.",
        ),
    ] = 60,
    audit_log: Annotated[
        Path | None,
        typer.Option(
            "--audit-log", metavar="FILE", help="Append a JSON line about each call: who read or wrote what."
        ),
    ] = None,
    requests_per_second: Annotated[
        float | None,
        typer.Option(
            "--requests-per-second",
            min=0.01,
            metavar="N",
            help="Mean number of calls of one key, or without keys of one address. If omitted, there is no limit.",
        ),
    ] = None,
    max_request: Annotated[
        str,
        typer.Option(
            "--max-request", metavar="SIZE", help="Largest request, and largest message of an upload."
        ),
    ] = "256MiB",
    max_upload: Annotated[
        str | None,
        typer.Option(
            "--max-upload",
            metavar="SIZE",
            help="Largest upload of one topic, in memory. If omitted, there is no limit.",
        ),
    ] = None,
    health_check: Annotated[
        bool,
        typer.Option(
            "--health-check",
            help="Start no server; exit with 0 if one responds at this host and port, else 1.",
        ),
    ] = False,
) -> None:
    """Serve the store to Mosaico clients until interrupted. Clients can list, read, query and write."""
    from mosaico_ingest.cli.process import (
        collect_garbage_as_usual,
        exit_on_signals,
        interrupt_on_sigterm,
        limit_heaps,
    )
    from mosaico_ingest.serve import Keyring, Limits, Tls, responds
    from mosaico_ingest.serve import serve as start_server

    if health_check:
        scheme = "grpc" if tls_cert is None else "grpc+tls"
        raise typer.Exit(0 if responds(f"{scheme}://{WILDCARDS.get(host, host)}:{port}") else 1)
    limits = Limits(
        requests_per_s=requests_per_second,
        request_bytes=_size(max_request, "--max-request"),
        upload_bytes=None if max_upload is None else _size(max_upload, "--max-upload"),
    )
    if (tls_cert is None) != (tls_key is None):
        raise ManifestError("--tls-cert and --tls-key need each other", hint="give both, or neither")
    if api_keys is not None:
        check_key_file(api_keys)
    tls = Tls(tls_cert, tls_key) if tls_cert is not None and tls_key is not None else None
    keyring = Keyring(api_keys) if api_keys is not None else None
    interrupt_on_sigterm()
    collect_garbage_as_usual()
    limit_heaps()
    server = start_server(
        store, host, port, keys=keyring, tls=tls, idle_s=idle_minutes * 60, limits=limits, audit_log=audit_log
    )
    try:
        typer.echo(f"serving {store} at {server.location}")
        if keyring is None:
            callers = "on this machine" if host in LOOPBACK else "who can reach this machine"
            typer.echo(
                f"warning: without --api-keys, everyone {callers} can read, write and delete", err=True
            )
        server.wait()
    except KeyboardInterrupt:
        typer.echo("stopping")
    all_closed = server.shutdown(grace_s=GRACE_S)
    exit_on_signals()
    if not all_closed:
        typer.echo("a call was still open; its unfinished uploads are discarded", err=True)
        sys.stdout.flush()
        os._exit(0)  # the thread of that call would keep the process alive for as long as the client likes


@keys_app.command()
def new(
    permission: Annotated[
        Permission,
        typer.Option("--permission", help="Permission of the key; each includes the previous ones."),
    ],
    api_keys: KeyFileOption = DEFAULT_KEY_FILE,
    description: Annotated[
        str, typer.Option("--description", metavar="TEXT", help="Owner or purpose of the key.")
    ] = "",
    expires: Annotated[
        str | None,
        typer.Option(
            "--expires",
            metavar="TIME",
            help="Expiry time, such as 2027-01-01T00:00:00Z.",
            show_default="never",
        ),
    ] = None,
) -> None:
    """Create a key and print it. The key cannot be displayed again."""
    from mosaico_ingest.protocol.messages import Permission as StoredPermission
    from mosaico_ingest.serve import Keyring

    expiry = _expiry(expires) if expires else None
    key = Keyring(api_keys).add(StoredPermission(permission.value), description=description, expires=expiry)
    typer.echo(key)
    typer.echo(f"added the hash of a key with {permission.value} permission to {api_keys}", err=True)


@keys_app.command("ls")
def list_keys(api_keys: KeyFileOption = DEFAULT_KEY_FILE) -> None:
    """List the keys with start of hash, permission, expiry and description."""
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.serve import Keyring

    check_key_file(api_keys)
    now = datetime.now(timezone.utc)
    for key in Keyring(api_keys).keys:
        expiry = key.expires.isoformat() if key.expires else "never"
        verb = "expired" if key.expires and key.expires <= now else "expires"
        line = f"{key.sha256[:12]}  {key.permission.value:6}  {verb} {expiry}  {key.description}"
        print_line(line.rstrip())


def check_key_file(file: Path) -> None:
    """Raise unless the key file exists.

    Raises:
        ManifestError: The file does not exist, so that every call would be refused.
    """
    if not file.exists():
        raise ManifestError(
            "the key file does not exist",
            where=str(file),
            hint=f"create it: ingest keys new --permission read --api-keys {file}",
        )


def browse(
    store: Annotated[
        str, typer.Argument(metavar="[STORE]", help="Folder or URL of the store.")
    ] = DEFAULT_STORE,
    port: Annotated[
        int,
        typer.Option("--port", min=0, max=65535, metavar="PORT", help="Port to listen on; 0 chooses one."),
    ] = DEFAULT_PORT,
    runs: Annotated[
        Path | None,
        typer.Option(
            "--runs",
            metavar="FOLDER",
            help="Folder with reports (`--report`), whose pages are listed.",
            show_default="STORE/runs",
        ),
    ] = None,
) -> None:
    """Show the sequences and runs of a store in a web browser on this machine, until interrupted. Read-only."""
    from mosaico_ingest.cli.process import collect_garbage_as_usual, hide_pandas, interrupt_on_sigterm
    from mosaico_ingest.pages.browser import BrowserServer

    collect_garbage_as_usual()
    hide_pandas()
    interrupt_on_sigterm()
    server = BrowserServer(store, port, runs=runs)
    try:
        typer.echo(f"showing {store} at {server.address}")
        server.serve_forever()
    except KeyboardInterrupt:
        typer.echo("stopping")
    finally:
        server.close()


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
    from mosaico_ingest.cli.process import collect_garbage_as_usual, interrupt_on_sigterm, set_up_logging
    from mosaico_ingest.errors import gravest
    from mosaico_ingest.job.manifest import load_manifests
    from mosaico_ingest.remote import as_path, with_network
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
            look_s = time.monotonic()
            complete = _settled(arrivals)
            if complete and not _ingest(manifest, complete, jobs, arrivals, codes, once=once):
                break
            if not complete and look_s > deadline:  # listing an object store may take longer than the rest
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


def _size(text: str, option: str) -> int:
    from mosaico_ingest.job.values import parse_size

    try:
        return parse_size(text)
    except ValueError as error:
        raise ManifestError(f"{option}: {error}") from error


def _expiry(text: str) -> datetime:
    hint = "write a future time such as 2027-01-01T00:00:00Z"
    try:
        expiry = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError as error:
        raise ManifestError(f"--expires {text!r} is not a time", hint=hint) from error
    if expiry.tzinfo is None:
        raise ManifestError(f"--expires {text!r} has no time zone", hint=hint)
    if expiry <= datetime.now(timezone.utc):
        raise ManifestError(f"--expires {text!r} is in the past", hint=hint)
    return expiry


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
    from mosaico_ingest.display import count_text, counted, seconds_text

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
