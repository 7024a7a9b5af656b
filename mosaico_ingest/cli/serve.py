"""This file is `ingest serve`: the platform's protocol over the embedded store."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["serve"]

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
    from mosaico_ingest.cli.collector import collect_as_usual
    from mosaico_ingest.cli.heap import share_heaps
    from mosaico_ingest.cli.keys import check_keys
    from mosaico_ingest.cli.signals import end_on_signals, interrupt_on_terminate
    from mosaico_ingest.errors import ManifestError
    from mosaico_ingest.store.server import Keyring, Tls
    from mosaico_ingest.store.server import serve as start

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
