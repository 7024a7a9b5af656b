"""`ingest serve` and `keys`."""

from __future__ import annotations

import os
import sys
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.errors import ManifestError

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


def _size(text: str, option: str) -> int:
    from mosaico_ingest.job.values import parse_size

    try:
        return parse_size(text)
    except ValueError as error:
        raise ManifestError(f"{option}: {error}") from error


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
