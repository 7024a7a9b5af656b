"""The Flight server over a store: permission checks, dispatch, start and stop."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct
from typing_extensions import Self

from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import ACTIONS, JSON, Body, Permission
from mosaico_ingest.remote import RemotePath, as_path
from mosaico_ingest.serve.actions import HANDLERS, Backend
from mosaico_ingest.serve.errors import Refusal, translate_errors
from mosaico_ingest.serve.flights import Flights
from mosaico_ingest.serve.keys import MIDDLEWARE, KeyCheck, Keyring, require
from mosaico_ingest.serve.uploads import Uploads

__all__ = [
    "IDLE_S",
    "PORT",
    "REQUEST_S",
    "Server",
    "Service",
    "Tls",
    "serve",
]


class Service(fl.FlightServerBase):
    """Serves one store; Flight calls each method on a thread of its own."""

    def __init__(
        self,
        store: Store,
        location: str,
        *,
        keyring: Keyring | None,
        certificates: list[tuple[bytes, bytes]] | None,
        request_s: float,
    ) -> None:
        self._uploads = Uploads(store)
        self._flights = Flights(store, self._uploads)
        self._backend = Backend(store, self._uploads, keyring, request_s)
        middleware = {MIDDLEWARE: KeyCheck(keyring)}
        super().__init__(location, tls_certificates=certificates, middleware=middleware)  # pyright: ignore[reportArgumentType] - PEM is bytes

    def drop_idle(self, idle_s: float) -> None:
        """Discard sessions whose clients have said nothing for so long."""
        self._uploads.discard_idle(idle_s)

    def drop_uploads(self) -> None:
        """Discard what was never finalized."""
        self._uploads.close()

    def list_flights(  # pyright: ignore[reportIncompatibleMethodOverride] - the criteria come as bytes
        self, context: fl.ServerCallContext, criteria: bytes
    ) -> Iterator[fl.FlightInfo]:
        """List the sequences."""
        with translate_errors():
            require(context, Permission.READ)
            if criteria not in {b"", b"/"}:
                raise Refusal(Condition.INVALID, "list_flights takes no criteria but '/'")
            return iter(list(self._flights.listed()))

    def get_flight_info(
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.FlightInfo:
        """Describe a sequence or a topic."""
        with translate_errors():
            require(context, Permission.READ)
            return self._flights.info(descriptor)

    def get_schema(  # pyright: ignore[reportIncompatibleMethodOverride] - Flight takes this wrapping only
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.SchemaResult:
        """Return the columns of a topic."""
        with translate_errors():
            require(context, Permission.READ)
            return fl.SchemaResult(self._flights.schema(descriptor))

    def do_get(self, context: fl.ServerCallContext, ticket: fl.Ticket) -> fl.FlightDataStream:
        """Stream a topic's rows."""
        with translate_errors():
            require(context, Permission.READ)
            schema, batches = self._flights.rows(ticket)
            return fl.GeneratorStream(schema, _translated(batches))

    def do_put(
        self,
        context: fl.ServerCallContext,
        descriptor: fl.FlightDescriptor,
        reader: fl.MetadataRecordBatchReader,
        writer: fl.FlightMetadataWriter,  # noqa: ARG002 - nothing is sent back before the end
    ) -> None:
        """Take the rows of a topic."""
        with translate_errors():
            require(context, Permission.WRITE)
            if descriptor.descriptor_type is not fl.DescriptorType.CMD:
                raise Refusal(Condition.INVALID, "the descriptor must have a command")
            put = JSON.decode(messages.Put, descriptor.command or b"")
            self._uploads.receive(put, reader.schema, _batches(reader))

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:
        """Execute an action."""
        with translate_errors():
            known = ACTIONS.get(action.type)
            if known is None or known not in HANDLERS:
                raise Refusal(Condition.UNIMPLEMENTED, f"action {action.type!r} is not implemented")
            require(context, known.permission)
            question = JSON.decode(known.question, action.body.to_pybytes() or b"{}")
            response = HANDLERS[known](self._backend, question)
            if isinstance(response, Body):
                return iter([JSON.encode_answer(known, response)])
            return iter([JSON.encode_answer(known, body) + b"\n" for body in response])


def _translated(batches: Iterator[pa.RecordBatch]) -> Generator[pa.RecordBatch, None, None]:
    with translate_errors():
        yield from batches


def _batches(reader: fl.MetadataRecordBatchReader) -> Iterator[pa.RecordBatch]:
    for chunk in reader:
        if chunk.data is None:
            raise Refusal(Condition.INVALID, "the upload contains a message without rows")
        yield chunk.data


PORT = 6726
"""The default port of clients."""
IDLE_S = 3600.0
"""Idle time after which an open session is discarded."""
REQUEST_S = 60.0
"""Time limit of a query."""
_GRACE_S = 10.0
_TIDY_S = 30.0
_HEARD_WITHIN_S = 0.5


class Tls(Struct, frozen=True):
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
    request_s: float = REQUEST_S,
) -> Server:
    """Serve the store in a folder, which is created if necessary; port 0 selects a free port.

    Without `keys`, every caller has every permission. A session that is idle for `idle_s` is discarded, and a query
    that takes longer than `request_s` is refused.

    Raises:
        SinkError: The store cannot be opened, the certificate cannot be read, or the port is taken.
    """
    path = as_path(store_path)
    if isinstance(path, RemotePath):
        raise SinkError(
            "only a store in a local folder can be served",
            where=str(path),
            hint="read the store through its URL",
        )
    store = Store.open(path)
    scheme = "grpc" if tls is None else "grpc+tls"
    certificates = None if tls is None else [(_read(tls.certificate), _read(tls.key))]
    try:
        service = Service(
            store, f"{scheme}://{host}:{port}", keyring=keys, certificates=certificates, request_s=request_s
        )
    except (OSError, pa.ArrowException) as err:
        text = str(err).splitlines()[0]
        raise SinkError(
            f"cannot listen: {text}",
            where=f"{host}:{port}",
            hint="check that the address belongs to this machine and that the port is free",
        ) from err
    return Server(service, store, host, scheme=scheme, idle_s=idle_s)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SinkError(f"cannot be read: {error.strerror}", where=str(path)) from error
