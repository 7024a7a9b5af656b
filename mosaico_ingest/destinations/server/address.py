"""The address of a server as a text: `HOST`, `HOST:PORT`, or a URL."""

from __future__ import annotations

import re
from pathlib import Path

from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import DEFAULT_PORT, ServerTarget

_SCHEMES = {"mosaico": False, "grpc": False, "mosaico+tls": True, "grpc+tls": True}
"""Whether each URL scheme uses TLS."""
_ADDRESS = re.compile(
    r"(?:(?P<scheme>[a-z+]+)://)?(?:\[(?P<v6>[^\]]+)\]|(?P<host>[^:/\[\]]+))(?::(?P<port>\d{1,5}))?/?"
)


def server_at(address: str, *, api_key: str | None = None, tls_cert: Path | None = None) -> ServerTarget:
    """Return the server at an address; the port defaults to 6726.

    Raises:
        SinkError: The text is not an address.
    """
    match = _ADDRESS.fullmatch(address.strip())
    port = int(match["port"] or DEFAULT_PORT) if match else 0
    if match is None or not 0 < port < 2**16 or (match["scheme"] or "mosaico") not in _SCHEMES:
        raise SinkError(
            f"{address!r} is not the address of a server",
            hint="write HOST:PORT, mosaico://HOST:PORT or, with TLS, mosaico+tls://HOST:PORT",
        )
    return ServerTarget(
        host=match["v6"] or match["host"],
        port=port,
        api_key=api_key,
        tls_cert=tls_cert,
        tls=_SCHEMES[match["scheme"] or "mosaico"] or tls_cert is not None,
    )
