"""The Flight server of a store: permission checks, dispatch, start and shutdown."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct
from typing_extensions import Self

from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import ACTIONS, JSON, Body, Permission
from mosaico_ingest.remote import RemotePath, as_path
from mosaico_ingest.serve.actions import HANDLERS, Backend
from mosaico_ingest.serve.flights import Flights, Uploads, question_of
from mosaico_ingest.serve.guard import (
    MIDDLEWARE,
    AuditLog,
    Call,
    Guard,
    KeyCheck,
    Keyring,
    Limits,
    Refusal,
    count_refused_schema,
    require,
    translate_errors,
)

PORT = 6726
"""The default port of Mosaico clients."""
IDLE_S = 3600.0
"""Idle time after which an open session is discarded, in seconds."""
REQUEST_S = 60.0
"""Time limit of a query, in seconds."""
NO_LIMITS = Limits()
"""The default limits: no limit of the rate."""
_GRACE_S = 10.0
"""Time for calls in progress to finish during a shutdown, in seconds."""
_CLEANUP_INTERVAL_S = 30.0
"""Maximum time between two checks for idle sessions, in seconds."""
_SIGNAL_INTERVAL_S = 0.5
"""Maximum delay of the response to a signal, in seconds."""


class Tls(Struct, frozen=True):
    """The PEM files of the certificate chain of a server and of its private key."""

    certificate: Path
    key: Path


class Service(fl.FlightServerBase):
    """The Flight service of one store; Flight runs each call on its own thread."""

    def __init__(
        self,
        store: Store,
        location: str,
        *,
        keyring: Keyring | None,
        certificates: list[tuple[bytes, bytes]] | None,
        request_s: float,
        guard: Guard | None = None,
    ) -> None:
        guard = guard or Guard(NO_LIMITS, AuditLog(None))
        self._guard = guard
        self._uploads = Uploads(store)
        self._flights = Flights(store, self._uploads)
        self._backend = Backend(store, self._uploads, keyring, request_s)
        middleware = {MIDDLEWARE: KeyCheck(keyring, guard.refused)}
        super().__init__(location, tls_certificates=certificates, middleware=middleware)  # pyright: ignore[reportArgumentType] - PEM is bytes

    def discard_idle(self, idle_s: float) -> None:
        """Discard the sessions without a call for `idle_s` seconds."""
        self._uploads.discard_idle(idle_s)

    def discard_unfinished(self) -> None:
        """Discard the sessions that are not finalized."""
        self._uploads.close()

    def list_flights(  # pyright: ignore[reportIncompatibleMethodOverride] - Flight passes the criteria as bytes
        self, context: fl.ServerCallContext, criteria: bytes
    ) -> Iterator[fl.FlightInfo]:
        """List the sequences."""
        with self._guard.call(context, "list_flights"):
            require(context, Permission.READ)
            if criteria not in {b"", b"/"}:
                raise Refusal(
                    Condition.INVALID,
                    f"the criteria {criteria!r} are not supported; list flights with '/' or without criteria",
                )
            return iter(list(self._flights.listed()))

    def get_flight_info(
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.FlightInfo:
        """Describe a sequence or a topic."""
        with self._guard.call(context, "get_flight_info") as call:
            require(context, Permission.READ)
            question = question_of(descriptor)
            call.target = question.resource_locator
            return self._flights.info(question, descriptor)

    def get_schema(  # pyright: ignore[reportIncompatibleMethodOverride] - Flight requires a SchemaResult
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.SchemaResult:
        """Return the schema of a topic.

        Flight has no statuses for this call: it sends the exception with its traceback, and never frees it.
        """
        try:
            with self._guard.call(context, "get_schema") as call:
                require(context, Permission.READ)
                question = question_of(descriptor)
                call.target = question.resource_locator
                return fl.SchemaResult(self._flights.schema(question))
        except fl.FlightError as error:
            count_refused_schema(context)
            refusal = error.with_traceback(None)
        raise refusal

    def do_get(self, context: fl.ServerCallContext, ticket: fl.Ticket) -> fl.FlightDataStream:
        """Stream the rows of a topic; the call is recorded when it is accepted."""
        with self._guard.call(context, "get") as call:
            require(context, Permission.READ)
            question = JSON.decode(messages.GetInfo, ticket.ticket)
            call.target = question.resource_locator
            schema, batches = self._flights.rows(question)
            return fl.GeneratorStream(schema, _with_translated_errors(batches))

    def do_put(
        self,
        context: fl.ServerCallContext,
        descriptor: fl.FlightDescriptor,
        reader: fl.MetadataRecordBatchReader,
        writer: fl.FlightMetadataWriter,  # noqa: ARG002 - no metadata is sent during an upload
    ) -> None:
        """Receive the rows of a topic."""
        with self._guard.call(context, "put") as call:
            require(context, Permission.WRITE)
            if descriptor.descriptor_type is not fl.DescriptorType.CMD:
                raise Refusal(Condition.INVALID, "the descriptor has no command; send a command descriptor")
            request = JSON.decode(messages.Put, descriptor.command or b"")
            call.target = request.resource_locator
            self._uploads.receive(request, reader.schema, self._batches(reader, call))

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:
        """Execute an action."""
        with self._guard.call(context, action.type) as call:
            definition = ACTIONS.get(action.type)
            if definition is None or definition not in HANDLERS:
                raise Refusal(Condition.UNIMPLEMENTED, f"action {action.type!r} is not implemented")
            require(context, definition.permission)
            self._guard.check_size(len(action.body), "the request")
            question = JSON.decode(definition.question, action.body.to_pybytes() or b"{}")
            call.target = _target_of(question)
            response = HANDLERS[definition](self._backend, question)
            if isinstance(response, Body):
                return iter([JSON.encode_answer(definition, response)])
            return iter([JSON.encode_answer(definition, body) + b"\n" for body in response])

    def _batches(self, reader: fl.MetadataRecordBatchReader, call: Call) -> Iterator[pa.RecordBatch]:
        for chunk in reader:
            if chunk.data is None:
                raise Refusal(Condition.INVALID, "the upload contains a message without rows")
            self._guard.add_upload(call, chunk.data.num_rows, chunk.data.get_total_buffer_size())
            yield chunk.data

    def list_actions(self, context: fl.ServerCallContext) -> Iterable[fl.Action]:  # noqa: ARG002 - Flight's signature
        """Refuse the call, as the platform's server does; Flight's own refusal sends a traceback and leaks."""
        raise as_flight_error(Condition.UNIMPLEMENTED, "ListActions is not implemented")

    def do_exchange(
        self,
        context: fl.ServerCallContext,  # noqa: ARG002 - Flight's signature
        descriptor: fl.FlightDescriptor,  # noqa: ARG002 - Flight's signature
        reader: fl.MetadataRecordBatchReader,  # noqa: ARG002 - Flight's signature
        writer: fl.MetadataRecordBatchWriter,  # noqa: ARG002 - Flight's signature
    ) -> None:
        """Refuse the call; see `list_actions`."""
        raise as_flight_error(Condition.UNIMPLEMENTED, "DoExchange is not implemented")


# Flight sends the traceback to the client, which must not see a path of this machine.
Service.get_schema.__code__ = Service.get_schema.__code__.replace(co_filename="mosaico_ingest")


class Server:
    """A running server; as a context manager, it shuts down at the end of the block."""

    def __init__(self, service: Service, store: Store, host: str, *, scheme: str, idle_s: float) -> None:
        self._service = service
        self._stopped = threading.Event()
        self.store_path = store.path
        self.host = host
        self.port = service.port
        self.location = f"{scheme}://{host}:{self.port}"
        """The location for Flight clients, such as `grpc://127.0.0.1:6726`."""
        threading.Thread(
            target=self._discard_idle_sessions, args=(idle_s,), name="mosaico-ingest-tidy", daemon=True
        ).start()

    def wait(self) -> None:
        """Block until the server is shut down; in contrast to Flight's own method, signals interrupt the wait."""
        while not self._stopped.wait(_SIGNAL_INTERVAL_S):
            pass  # a signal that another thread receives does not interrupt an unlimited wait

    def shutdown(self, *, grace_s: float = _GRACE_S) -> bool:
        """Refuse new calls, wait up to `grace_s` seconds for calls in progress, and discard the sessions not finalized.

        Return whether all calls ended in time. Flight cannot abort the call of a silent client, and a process with
        such a call cannot exit normally.
        """
        stopping = threading.Thread(target=self._service.shutdown, name="mosaico-ingest-stop", daemon=True)
        stopping.start()
        stopping.join(grace_s)
        self._service.discard_unfinished()
        self._stopped.set()
        return not stopping.is_alive()

    def _discard_idle_sessions(self, idle_s: float) -> None:
        while not self._stopped.wait(min(idle_s / 4, _CLEANUP_INTERVAL_S)):
            self._service.discard_idle(idle_s)

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
    limits: Limits = NO_LIMITS,
    audit_log: Path | None = None,
) -> Server:
    """Serve the store in a folder, which is created if necessary; port 0 selects a free port.

    Without `keys`, every caller has every permission. A session that is idle for `idle_s` is discarded, and a query
    that takes longer than `request_s` is refused. `audit_log` names the file that records every call.

    Raises:
        SinkError: The store cannot be opened, the certificate cannot be read, the audit log cannot be written, or the port
            is in use.
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
            store,
            f"{scheme}://{host}:{port}",
            keyring=keys,
            certificates=certificates,
            request_s=request_s,
            guard=Guard(limits, AuditLog(audit_log)),
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
        raise SinkError(f"the PEM file cannot be read: {error.strerror}", where=str(path)) from error


def _with_translated_errors(batches: Iterator[pa.RecordBatch]) -> Generator[pa.RecordBatch, None, None]:
    with translate_errors():
        yield from batches


def _target_of(question: Body) -> str:
    """Return the locator in the question of an action, or its other reference to an object."""
    names = ("locator", "resource_locator", "session_uuid", "api_key_fingerprint")
    return next((str(value) for name in names if (value := getattr(question, name, None))), "")
