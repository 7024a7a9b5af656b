"""This file starts and stops a server."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.errors import SinkError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import RemotePath, as_path
from mosaico_ingest.store.server.keyring import Keyring
from mosaico_ingest.store.server.service import Service
from mosaico_ingest.store.store import Store

__all__ = ["IDLE_S", "PORT", "Server", "Tls", "serve"]

PORT = 6726
"""Where clients look unless told otherwise."""
IDLE_S = 3600.0
"""How long a session may stay open without a word from its client."""
_GRACE_S = 10.0
_TIDY_S = 30.0
_HEARD_WITHIN_S = 0.5


@frozen
class Tls:
    """The PEM files of the certificate chain a server shows, and of its private key."""

    certificate: Path
    key: Path


class Server:
    """A running server; leaving it as a context shuts it down."""

    def __init__(self, service: Service, store: Store, host: str, *, scheme: str, idle_s: float) -> None:
        self._service = service
        self._stopped = threading.Event()
        self.store_path = store.path
        self.host = host
        self.port = service.port
        self.location = f"{scheme}://{host}:{self.port}"
        """What a Flight client connects to."""
        threading.Thread(target=self._tidy, args=(idle_s,), name="mosaico-ingest-tidy", daemon=True).start()

    def wait(self) -> None:
        """Block until the server is shut down; unlike Flight's own way to wait, signals are heard."""
        while not self._stopped.wait(_HEARD_WITHIN_S):
            pass  # a signal that the system gave to another thread does not end a wait

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

    def _tidy(self, idle_s: float) -> None:
        while not self._stopped.wait(min(idle_s / 4, _TIDY_S)):
            self._service.drop_idle(idle_s)

    def __enter__(self) -> Self:
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
    idle_s: float = IDLE_S,
) -> Server:
    """Serve the store in the folder, which is made where there is none; port 0 takes a free one.

    Without `keys` every caller may do everything. A session whose client says nothing for `idle_s` is discarded.

    Raises:
        SinkError: The store cannot be opened, the certificate cannot be read, or the port is taken.
    """
    place = as_path(store_path)
    if isinstance(place, RemotePath):
        raise SinkError(
            "a server answers from a store on a disk", where=str(place), hint="read the store where it lies"
        )
    store = Store.open(place)
    scheme = "grpc" if tls is None else "grpc+tls"
    certificates = None if tls is None else [(_read(tls.certificate), _read(tls.key))]
    try:
        service = Service(store, f"{scheme}://{host}:{port}", keyring=keys, certificates=certificates)
    except (OSError, pa.ArrowException) as err:
        text = str(err).splitlines()[0]
        raise SinkError(
            f"cannot listen: {text}",
            where=f"{host}:{port}",
            hint="is the address this machine's, and the port free?",
        ) from err
    return Server(service, store, host, scheme=scheme, idle_s=idle_s)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SinkError(f"cannot be read: {error.strerror}", where=str(path)) from error
