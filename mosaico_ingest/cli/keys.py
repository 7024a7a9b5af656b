"""This file is `ingest keys`: the API keys of a served store."""

from __future__ import annotations

from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app", "check_keys"]

app = typer.Typer(no_args_is_help=True, help="Make and list the API keys of `ingest serve`.")

KeysFile = Annotated[Path, typer.Option("--api-keys", metavar="FILE", help="The file of keys.")]
DEFAULT = Path("api_keys.json")


class Permission(str, Enum):
    """What a key may do; each includes the ones before it."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    MANAGE = "manage"


@app.command()
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
    from mosaico_ingest.store.server import Keyring
    from mosaico_ingest.wire.actions import Permission as Granted

    until = _instant(expires) if expires else None
    key = Keyring(api_keys).add(Granted(permission.value), description=description, expires=until)
    typer.echo(key)
    typer.echo(
        f"{permission.value} permission, kept as a hash in {api_keys}; a server reads it when it starts",
        err=True,
    )


@app.command("ls")
def list_keys(api_keys: KeysFile = DEFAULT) -> None:
    """List the keys: what they may do and until when; the keys themselves are not kept."""
    from mosaico_ingest.store.server import Keyring

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
