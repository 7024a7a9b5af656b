"""`ingest serve` and `keys`."""

from __future__ import annotations

import os
import sys
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

__all__ = [
    "check_keys",
    "keys_app",
    "serve",
]

keys_app = typer.Typer(no_args_is_help=True, help="Make and list the API keys of `ingest serve`.")

KeysFile = Annotated[Path, typer.Option("--api-keys", metavar="FILE", help="The file of keys.")]
DEFAULT = Path("api_keys.json")


class Permission(str, Enum):
    """What a key may do; each includes the ones before it."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    MANAGE = "manage"


@keys_app.command()
def new(
    permission: Annotated[Permission, typer.Option("--permission", help="Each includes the ones before it.")],
    api_keys: KeysFile = DEFAULT,
    description: Annotated[str, typer.Option("--description", help="Who or what the key is for.")] = "",
    expires: Annotated[
        str | None,
        typer.Option("--expires", metavar="TIME", help="As 2027-01-01T00:00:00Z; never without it."),
    ] = None,
) -> None:
    """Make a key and print it: this is the only time it can be seen."""
    from mosaico_ingest.protocol.messages import Permission as Granted
    from mosaico_ingest.serve import Keyring

    until = _instant(expires) if expires else None
    key = Keyring(api_keys).add(Granted(permission.value), description=description, expires=until)
    typer.echo(key)
    typer.echo(
        f"{permission.value} permission, kept as a hash in {api_keys}; a server reads it when it starts",
        err=True,
    )


@keys_app.command("ls")
def list_keys(api_keys: KeysFile = DEFAULT) -> None:
    """List the keys: what they may do and until when; the keys themselves are not kept."""
    from mosaico_ingest.serve import Keyring

    check_keys(api_keys)
    now = datetime.now(timezone.utc)
    for key in Keyring(api_keys).keys:
        until = key.expires.isoformat() if key.expires else "never"
        ends = "expired" if key.expires and key.expires <= now else "expires"
        typer.echo(f"{key.sha256[:12]}  {key.permission.value:6}  {ends} {until}  {key.description}".rstrip())


def check_keys(file: Path) -> None:
    """Refuse a file of keys that is not there: a key ring without keys is hardly meant."""
    from mosaico_ingest.errors import ManifestError

    if not file.exists():
        raise ManifestError(
            "there is no such file of keys", where=str(file), hint="make one: ingest keys new"
        )


def _instant(text: str) -> datetime:
    from mosaico_ingest.errors import ManifestError

    form = "write it as 2027-01-01T00:00:00Z"
    try:
        instant = datetime.fromisoformat(text.replace("Z", "+00:00"))
    except ValueError as error:
        raise ManifestError(f"--expires {text!r} is no time", hint=form) from error
    if instant.tzinfo is None:
        raise ManifestError(f"--expires {text!r} has no time zone", hint=form)
    if instant <= datetime.now(timezone.utc):
        raise ManifestError(f"--expires {text!r} has passed", hint="name a time to come")
    return instant


LOOPBACK = {"127.0.0.1", "::1", "[::1]", "localhost"}
GRACE_S = 0.5


def serve(
    store: Annotated[Path, typer.Option("--store", metavar="DIR", help="The store's folder.")] = Path(
        "mosaico"
    ),
    host: Annotated[str, typer.Option("--host", help="The address to listen on.")] = "127.0.0.1",
    *,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 6726,
    api_keys: Annotated[
        Path | None,
        typer.Option("--api-keys", metavar="FILE", help="Who may do what; see `ingest keys new`."),
    ] = None,
    tls_cert: Annotated[Path | None, typer.Option("--tls-cert", help="The certificate to show, PEM.")] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="Its private key, PEM.")] = None,
    idle_minutes: Annotated[
        float,
        typer.Option("--idle-minutes", min=0.01, help="A session is discarded after so long without a word."),
    ] = 60,
) -> None:
    """Let clients of the platform list, read, query and write the store; until it is interrupted."""
    from mosaico_ingest.cli.process import (
        collect_as_usual,
        end_on_signals,
        interrupt_on_terminate,
        share_heaps,
    )
    from mosaico_ingest.errors import ManifestError
    from mosaico_ingest.serve import Keyring, Tls
    from mosaico_ingest.serve import serve as start

    if (tls_cert is None) != (tls_key is None):
        raise ManifestError("--tls-cert and --tls-key go together", hint="give both, or neither")
    if api_keys is not None:
        check_keys(api_keys)
    tls = Tls(tls_cert, tls_key) if tls_cert is not None and tls_key is not None else None
    keys = Keyring(api_keys) if api_keys is not None else None
    interrupt_on_terminate()
    collect_as_usual()
    share_heaps()
    server = start(store, host, port, keys=keys, tls=tls, idle_s=idle_minutes * 60)
    try:
        typer.echo(f"serving {store} at {server.location}")
        if keys is None:
            reach = "who can reach this machine" if host not in LOOPBACK else "on this machine"
            typer.echo(f"warning: without --api-keys everybody {reach} may read, write and delete", err=True)
        server.wait()
    except KeyboardInterrupt:
        typer.echo("stopping")
    done = server.shutdown(grace_s=GRACE_S)
    end_on_signals()
    if not done:
        typer.echo("a client's call was still open; what it had not finalized is discarded", err=True)
        sys.stdout.flush()
        os._exit(0)  # the thread of that call would keep the process for as long as the client likes
