"""This file starts and stops a server."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import pyarrow as pa

from mosaico_ingest.errors import SinkError
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.server.keyring import Keyring
from mosaico_ingest.store.server.service import Service
from mosaico_ingest.store.store import Store

__all__ = ["PORT", "Server", "Tls", "serve"]

PORT = 6726
"""Where clients look unless told otherwise."""
_GRACE_S = 10.0


@dataclass(frozen=True, slots=True)
class Tls:
    """The PEM files of the certificate chain a server shows, and of its private key."""

    certificate: Path
    key: Path


class Server:
    """A running server; leaving it as a context shuts it down."""

    def __init__(self, service: Service, store: Store, host: str, *, scheme: str) -> None:
        self._service = service
        self._stopped = threading.Event()
        self.store_path = store.path
        self.host = host
        self.port = service.port
        self.location = f"{scheme}://{host}:{self.port}"
        """What a Flight client connects to."""

    def wait(self) -> None:
        """Block until the server is shut down; unlike Flight's own way to wait, signals are heard."""
        self._stopped.wait()

    def shutdown(self, *, grace_s: float = _GRACE_S) -> bool:
        """Stop taking calls, wait for those under way, and discard what was never finalized.

        Returns whether all calls ended in time. Flight cannot end the call of a client that says nothing, nor
        can a process that has one end normally.
        """
        stopping = threading.Thread(target=self._service.shutdown, name="mosaico-ingest-stop", daemon=True)
        stopping.start()
        stopping.join(grace_s)
        self._service.drop_uploads()
        self._stopped.set()
        return not stopping.is_alive()

    def __enter__(self) -> Server:  # noqa: PYI034 - Self comes with Python 3.11, and nobody derives from this
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.shutdown()


def serve(
    store_path: str | Path,
    host: str = "127.0.0.1",
    port: int = PORT,
    *,
    keys: Keyring | None = None,
    tls: Tls | None = None,
) -> Server:
    """Serve the store in the folder, which is made where there is none; port 0 takes a free one.

    Without `keys` every caller may do everything.

    Raises:
        SinkError: The store cannot be opened, the certificate cannot be read, or the port is taken.
    """
    store = Store.open(store_path)
    scheme = "grpc" if tls is None else "grpc+tls"
    certificates = None if tls is None else [(_read(tls.certificate), _read(tls.key))]
    try:
        service = Service(store, f"{scheme}://{host}:{port}", keyring=keys, certificates=certificates)
    except (OSError, pa.ArrowException) as err:
        text = str(err).splitlines()[0]
        raise SinkError(f"cannot listen: {text}", where=f"{host}:{port}", hint="is the port taken?") from err
    return Server(service, store, host, scheme=scheme)


def _read(path: Path) -> bytes:
    with explained(path):
        return path.read_bytes()
