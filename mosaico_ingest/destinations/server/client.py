"""A connection to a Mosaico server: address, handshake, actions, queries and uploads, with deadlines and errors."""

from __future__ import annotations

import json
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.flight as fl
from msgspec import Struct

from mosaico_ingest.destinations import validated
from mosaico_ingest.errors import IngestError, SinkError, SinkUnavailable
from mosaico_ingest.job.values import DEFAULT_PORT, ServerTarget
from mosaico_ingest.ontology.registry import SerializationFormat
from mosaico_ingest.protocol import key_problem, messages
from mosaico_ingest.protocol.errors import Condition, condition_of, text_of
from mosaico_ingest.protocol.messages import (
    API_KEY_HEADER,
    INFO,
    JSON,
    VERSION,
    Action,
    Body,
    Codec,
    Malformed,
    Permission,
)

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


_PATIENCE_S = 3.0
_WRONG_NAME = frozenset({62, 64})
"""OpenSSL's verification codes for a certificate of another host name or IP address."""
_NO_HTTP2 = "Failed parsing HTTP/2"
"""Part of gRPC's message for a server of another protocol, for example a web server."""
_KEY_HINT = "set target.api_key or MOSAICO_API_KEY"


class Refused(SinkError):  # noqa: N818 - the condition, as in `errors`
    """The server refused a call; `condition` is its status."""

    def __init__(
        self, what: str, *, where: str | None = None, hint: str | None = None, condition: Condition
    ) -> None:
        super().__init__(what, where=where, hint=hint)
        self.condition = condition


@dataclass(frozen=True, slots=True)
class Address:
    """The address of a server, and the credentials for it."""

    host: str
    port: int
    tls: bool
    roots: str | None = field(default=None, repr=False)
    """Trusted certificates, PEM; None: those of the system."""
    key: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'grpc+tls' if self.tls else 'grpc'}://{host}:{self.port}"


def add_hint(error: IngestError, hint: str) -> None:
    """Append a hint to an error."""
    error.hint = f"{error.hint}; {hint}" if error.hint else hint


def check_tls(address: Address) -> None:
    """Raise SinkError if the server's certificate is not trusted; gRPC would print a vague message to the terminal."""
    try:
        connection = socket.create_connection((address.host, address.port), timeout=_PATIENCE_S)
    except OSError:
        return  # gRPC may connect through a proxy; if not, `reraise` explains the error
    with connection:
        fault = _tls_fault(connection, address)
    if fault is not None:
        raise fault


def late(address: Address, action: str) -> SinkUnavailable:
    """Return the error of a call that did not end in time."""
    hint = "check the load of the server, then try again"
    return SinkUnavailable(f"the server did not respond to {action} in time", where=str(address), hint=hint)


def reraise(error: Exception, address: Address, *, action: str, needs: Permission) -> NoReturn:
    """Raise the SinkError for an error of Flight.

    Raises:
        Refused: The server refused the call.
        SinkUnavailable: The server did not respond; a retry may succeed.
        SinkError: The server cannot be reached with these settings.
    """
    secret = address.key is not None and address.key in str(error)
    raise _explained(error, address, action=action, needs=needs) from (None if secret else error)


def _explained(error: Exception, address: Address, *, action: str, needs: Permission) -> SinkError:
    condition, text = condition_of(error), text_of(error)
    if address.key:
        text = text.replace(address.key, "<the key>")
    where = str(address)
    if condition is Condition.UNAVAILABLE:
        return _diagnosed(address, text)
    if condition is Condition.TIMED_OUT:
        return late(address, action)
    if condition in {Condition.UNAUTHENTICATED, Condition.PERMISSION}:
        what, hint = _about_key(address.key, condition, text, action=action, needs=needs)
        return Refused(what, where=where, hint=hint, condition=condition)
    return Refused(f"{action} is refused: {text}", where=where, condition=condition)


def _about_key(
    key: str | None, condition: Condition, text: str, *, action: str, needs: Permission
) -> tuple[str, str]:
    if not key:
        return "the server requires an API key", _KEY_HINT
    problem = key_problem(key)
    if problem:
        return f"the API key is refused: {problem}", _KEY_HINT
    if condition is Condition.PERMISSION:
        return (
            f"the API key has no permission for {action} ({text})",
            f"use a key with the permission {needs.value}",
        )
    return (
        f"the API key is refused ({text})",
        "check that the key belongs to this server and has not expired or been revoked",
    )


def _diagnosed(address: Address, text: str) -> SinkError:
    """Return the reason why there is no connection, found by connecting step by step."""
    where = str(address)
    try:
        connection = socket.create_connection((address.host, address.port), timeout=_PATIENCE_S)
    except socket.gaierror:
        return SinkError(
            f"the host {address.host!r} cannot be resolved", where=where, hint="check target.host"
        )
    except ConnectionRefusedError:
        hint = "check target.host and target.port, and that the server is running"
        return SinkUnavailable("the connection is refused", where=where, hint=hint)
    except OSError as error:
        why = error.strerror or f"no response within {_PATIENCE_S:g} s"
        return SinkUnavailable(why, where=where, hint="check target.host and the network")
    with connection:
        fault = _tls_fault(connection, address) if address.tls else _plain_fault(connection, address)
    if fault is None and _NO_HTTP2 in text:
        hint = "check target.host and target.port"
        return SinkError("the program at this address is not a Mosaico server", where=where, hint=hint)
    return fault or SinkUnavailable(f"the server does not respond: {text}", where=where, hint="try again")


def _tls_fault(connection: socket.socket, address: Address) -> SinkError | None:
    where = str(address)
    context = ssl.create_default_context(cadata=address.roots)
    context.set_alpn_protocols(["h2"])
    try:
        context.wrap_socket(connection, server_hostname=address.host).close()
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _WRONG_NAME:
            hint = "use the name the certificate is for as target.host"
            return SinkError(f"the certificate is not for {address.host!r}", where=where, hint=hint)
        hint = "set target.tls_cert to the certificate of the server's authority"
        return SinkError(f"the certificate is not trusted: {error.verify_message}", where=where, hint=hint)
    except ssl.SSLError as error:
        if "ALERT" in (error.reason or ""):
            return SinkError(f"the server refuses the TLS handshake: {error.reason}", where=where)
        return SinkError("the server does not use TLS", where=where, hint="set target.tls: false")
    except OSError:
        return None
    return None


def _plain_fault(connection: socket.socket, address: Address) -> SinkError | None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # nothing is sent: this only tests whether the server uses TLS
    context.set_alpn_protocols(["h2"])
    try:
        context.wrap_socket(connection, server_hostname=address.host).close()
    except OSError:
        return None
    hint = "set target.tls: true, or target.tls_cert"
    return SinkError("the server accepts only TLS connections", where=str(address), hint=hint)


_Returned = TypeVar("_Returned")

DeadlinePassed = FutureTimeout
"""A call did not end in time; its thread continues, since only the server can end it."""


def within(seconds: float, call: Callable[[], _Returned]) -> _Returned:
    """Return the call's result, or raise its exception.

    Raises:
        DeadlinePassed: The call takes longer.
    """
    return in_thread(call).result(seconds)


def in_thread(call: Callable[[], _Returned]) -> Future[_Returned]:
    """Run the call on a thread that does not keep the process alive."""
    outcome: Future[_Returned] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as error:  # noqa: BLE001 - raised again by `Future.result`
            outcome.set_exception(error)

    threading.Thread(target=work, name="mosaico-ingest-call", daemon=True).start()
    return outcome


_RESPONSE_S = 120.0
_MARGIN_S = 5.0
"""Added to gRPC's own time limit, so that its more specific error wins."""
_CLOSE_S = 1.0
_DELAYS_S = (0.2, 0.6, 1.8)
_CHANNEL: list[tuple[str, Any]] = [
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1000),
]
_HOST = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:.]+%\w+")
"""A host name, or an IPv6 address with its interface."""
_USER_METADATA = b"mosaico:user_metadata"
_PROPERTIES = b"mosaico:properties"
_UNKNOWN = frozenset({Condition.UNIMPLEMENTED, Condition.INVALID, Condition.NOT_FOUND})

_Question = TypeVar("_Question", bound=Body)
_Answer = TypeVar("_Answer", bound=Body)
_Result = TypeVar("_Result")


class Uploaded(Struct, frozen=True):
    """The content of a topic that a server reports."""

    rows: int
    start_ns: int | None
    end_ns: int | None
    """Inclusive."""
    stored_bytes: int


class ServerClient:
    """A connection to a server that responded to the handshake; created by `connect`."""

    def __init__(self, flight: fl.FlightClient, address: Address, codec: Codec, response_s: float) -> None:
        self.address = address
        self.version = "unknown"
        self.limit_bytes = messages.DEFAULT_LIMIT_BYTES
        """The largest message that the server accepts and sends."""
        self._flight = flight
        self._codec = codec
        self._response_s = response_s
        key = [(API_KEY_HEADER.encode(), address.key.encode())] if address.key else []
        headers = cast("list[tuple[str, str]]", key)  # the stubs expect text, Flight expects bytes
        self._stream_options = fl.FlightCallOptions(headers=headers)
        self._options = fl.FlightCallOptions(headers=headers, timeout=response_s)

    def handshake(self) -> None:
        """Ask for the version and limits; a server that does not know `info` is asked for its version only.

        Raises:
            SinkError: The address is not a Mosaico server, or the server does not accept the API key.
        """
        try:
            info = self.act(INFO, messages.Empty())
        except Refused as refusal:
            if refusal.condition not in _UNKNOWN:
                raise
            self.version = self._version_before_0_7()
        else:
            self.version = info.version
            limits = info.config
            self.limit_bytes = min(limits.grpc_max_decode_message_size, limits.grpc_max_encode_message_size)

    def act(self, action: Action[_Question, _Answer], question: _Question) -> _Answer:
        """Call an action and return its response.

        Raises:
            Refused: The server refused the action.
            SinkUnavailable: The server did not respond.
        """

        def call() -> bytes:
            request = fl.Action(action.name, self._codec.encode(question))
            return b"".join(
                result.body.to_pybytes() for result in self._flight.do_action(request, self._options)
            )

        data = self._call(call, action.name, action.permission, repeatable=action.repeatable)
        with self._decoding(action.name):
            return self._codec.decode_answer(action, data)

    def find(self, sequence: str) -> messages.SequenceInfo | None:
        """Return the sequence, or None.

        Servers before 0.7 send the user metadata in the metadata of the schema only.
        """
        try:
            info = self._info(sequence)
        except Refused as refusal:
            if refusal.condition is Condition.NOT_FOUND:
                return None
            raise
        with self._decoding("get_flight_info"):
            described = self._codec.decode(messages.SequenceInfo, _bytes(info.app_metadata) or b"{}")
            if described.user_metadata:
                return described
            return described.model_copy(update={"user_metadata": _schema_metadata(info.schema)})

    def uploaded(self, sequence: str) -> dict[str, Uploaded]:
        """Return the content of each topic of a sequence by locator; topics without reported counts are missing."""
        endpoints = map(self._topic_info, self._info(sequence).endpoints)
        return {
            about.resource_locator: _uploaded(about.data_info)
            for about in endpoints
            if about is not None and about.data_info is not None
        }

    def count_rows(self, locator: str) -> Uploaded:
        """Return the content of a topic by reading its rows, for servers that do not report counts."""
        info = self._info(locator)
        reader = self._open_rows(info.endpoints[0].ticket).to_reader()
        rows = 0
        bounds: list[int] = []
        while (batch := self._once(lambda: next(reader, None), "do_get", Permission.READ)) is not None:
            # only the time stamps are touched: other columns may lack offsets, see `with_offsets`
            times = pc.min_max(batch.column("timestamp_ns"))
            rows += batch.num_rows
            bounds += [at for at in (times["min"].as_py(), times["max"].as_py()) if at is not None]
        stored_bytes = max(0, info.total_bytes)
        return Uploaded(rows, min(bounds, default=None), max(bounds, default=None), stored_bytes)

    def sequence_names(self) -> list[str]:
        """Return the names of all sequences."""

        def call() -> list[str]:
            flights = self._flight.list_flights(options=self._options)
            return [b"/".join(info.descriptor.path or ()).decode() for info in flights]

        return self._call(call, "list_flights", Permission.READ, repeatable=True)

    def topic_infos(self, sequence: str) -> tuple[messages.TopicInfo, ...]:
        """Return the topics of a sequence, with their metadata.

        Servers before 0.7 list the topics in the sessions of the sequence, and describe each in its schema only.

        Raises:
            SinkError: The server refuses the request, or its response cannot be decoded.
        """
        info = self._info(sequence)
        described = {
            about.resource_locator: about
            for about in map(self._topic_info, info.endpoints)
            if about is not None
        }
        with self._decoding("get_flight_info"):
            sessions = self._codec.decode(messages.SequenceInfo, _bytes(info.app_metadata) or b"{}").sessions
            locators = (locator for session in sessions for locator in session.topics)
            return tuple(
                about
                if (about := described.get(locator)) and (about.user_metadata or not about.locked)
                else self._topic_of_schema(locator, about)
                for locator in dict.fromkeys((*described, *locators))
            )

    def topic_schema(self, locator: str) -> pa.Schema:
        """Return the columns of a topic, including the timestamp."""
        question = messages.GetInfo(resource_locator=locator)
        descriptor = fl.FlightDescriptor.for_command(self._codec.encode(question))

        def call() -> pa.Schema:
            result: Any = self._flight.get_schema(descriptor, self._options)  # the stubs return a Schema
            return result.schema

        return self._call(call, "get_schema", Permission.READ, repeatable=True)

    def rows(
        self, locator: str, start_ns: int | None = None, end_ns: int | None = None
    ) -> Generator[pa.RecordBatch, None, None]:
        """Yield the rows of a topic as the server sends them, one message at a time; `end_ns` is exclusive.

        Raises:
            SinkError: The server refuses the request, the connection breaks, or a batch is invalid.
        """
        stream = self._open_rows(self._info(locator, start_ns, end_ns).endpoints[0].ticket)
        reader = stream.to_reader()
        try:
            while (batch := self._once(lambda: next(reader, None), "do_get", Permission.READ)) is not None:
                yield self._once(partial(validated, batch), "do_get", Permission.READ)
        finally:
            with suppress(DeadlinePassed, pa.ArrowException, OSError):
                within(_CLOSE_S, stream.cancel)

    def put(self, put: messages.Put, schema: pa.Schema) -> fl.FlightStreamWriter:
        """Start an upload."""
        descriptor = fl.FlightDescriptor.for_command(self._codec.encode(put))

        def call() -> fl.FlightStreamWriter:
            return self._flight.do_put(descriptor, schema, self._stream_options)[0]

        return self._call(call, "do_put", Permission.WRITE, repeatable=False)

    @contextmanager
    def _decoding(self, action: str) -> Generator[None, None, None]:
        try:
            yield
        except Malformed as error:
            raise SinkError(
                f"the response to {action} cannot be decoded: {error}",
                where=str(self.address),
                hint="check that this is a Mosaico server of version 0.5 to 0.7",
            ) from error

    def _open_rows(self, ticket: fl.Ticket) -> fl.FlightStreamReader:
        return self._call(
            lambda: self._flight.do_get(ticket, self._stream_options),
            "do_get",
            Permission.READ,
            repeatable=True,
        )

    def _info(self, locator: str, start_ns: int | None = None, end_ns: int | None = None) -> fl.FlightInfo:
        question = messages.GetInfo(
            resource_locator=locator, timestamp_ns_start=start_ns, timestamp_ns_end=end_ns
        )
        descriptor = fl.FlightDescriptor.for_command(self._codec.encode(question))
        return self._call(
            lambda: self._flight.get_flight_info(descriptor, self._options),
            "get_flight_info",
            Permission.READ,
            repeatable=True,
        )

    def _topic_info(self, endpoint: fl.FlightEndpoint) -> messages.TopicInfo | None:
        try:
            return self._codec.decode(messages.TopicInfo, _bytes(endpoint.app_metadata))
        except Malformed:
            return None

    def _topic_of_schema(self, locator: str, about: messages.TopicInfo | None) -> messages.TopicInfo:
        """Return the description of a topic, completed with the metadata of its schema."""
        schema = self._info(locator).schema
        metadata = _schema_metadata(schema)
        if about is not None:
            return about.model_copy(update={"user_metadata": metadata})
        properties = _schema_metadata(schema, _PROPERTIES)
        return messages.TopicInfo(
            resource_locator=locator,
            ontology_tag=str(properties.get("ontology_tag", "")),
            serialization_format=_layout(properties.get("serialization_format")),
            user_metadata=metadata,
            created_at_ns=0,
            locked=True,
            data_info=None,
        )

    def _version_before_0_7(self) -> str:
        try:
            return self.act(VERSION, messages.Empty()).version
        except Refused as refusal:
            if refusal.condition in _UNKNOWN:
                raise SinkError(
                    "the Flight server at this address is not a Mosaico server",
                    where=str(self.address),
                    hint="check target.host and target.port",
                ) from refusal
            raise

    def _call(
        self, call: Callable[[], _Result], action: str, needs: Permission, *, repeatable: bool
    ) -> _Result:
        """Call, and retry with delays if the server was unavailable and a repetition has no side effect."""
        for delay_s in _DELAYS_S if repeatable else ():
            try:
                return self._once(call, action, needs)
            except SinkUnavailable as error:
                if _was_slow(error):
                    raise
            time.sleep(delay_s)
        return self._once(call, action, needs)

    def _once(self, call: Callable[[], _Result], action: str, needs: Permission) -> _Result:
        try:
            return within(self._response_s + _MARGIN_S, call)
        except DeadlinePassed as error:
            raise late(self.address, action) from error
        except (pa.ArrowException, OSError) as error:  # a stream that breaks is an OSError
            reraise(error, self.address, action=action, needs=needs)


@contextmanager
def connect(
    target: ServerTarget, *, codec: Codec = JSON, response_s: float = _RESPONSE_S, handshake: bool = True
) -> Generator[ServerClient, None, None]:
    """Connect to a server, perform the handshake unless it is disabled, and close the connection at the end.

    Raises:
        SinkError: The server cannot be reached, or does not accept the API key.
    """
    address = _address(target)
    if address.tls:
        check_tls(address)
    flight = fl.FlightClient(str(address), tls_root_certs=address.roots, generic_options=_CHANNEL)
    try:
        client = ServerClient(flight, address, codec, response_s)
        if handshake:
            client.handshake()
        yield client
    finally:
        with suppress(DeadlinePassed):
            within(_CLOSE_S, flight.close)  # it waits for calls under way, which may be stuck


def _was_slow(error: SinkUnavailable) -> bool:
    """Return whether the server was reachable but too slow: a retry would only add load."""
    cause = error.__cause__
    return isinstance(cause, DeadlinePassed) or condition_of(cause or error) is Condition.TIMED_OUT


def _address(target: ServerTarget) -> Address:
    key = target.api_key
    if key and not (key.isascii() and key.isprintable() and " " not in key):
        raise SinkError(
            "the API key contains characters that are not allowed",
            hint="remove blanks and line breaks around the key",
        )
    _check_host(target.host)
    return Address(target.host, target.port, target.tls or target.tls_cert is not None, _roots(target), key)


def _check_host(host: str) -> None:
    """Raise SinkError if the text cannot be a host, for example a URL or a host with a port."""
    with suppress(ValueError):
        ip_address(host)
        return
    if not host or not _HOST.fullmatch(host):
        raise SinkError(
            f"host {host!r} is neither a host name nor an IP address",
            hint="set target.host without scheme and port, and set target.port",
        )


def _roots(target: ServerTarget) -> str | None:
    if target.tls_cert is None:
        return None
    try:
        roots = target.tls_cert.read_text("ascii", errors="ignore")  # bundles carry comments in any script
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cadata=roots)
    except (ssl.SSLError, ValueError):
        what, hint = "it contains no certificate", "use a file in PEM format"
    except OSError as error:
        what, hint = error.strerror or str(error), "check target.tls_cert"
    else:
        return roots
    raise SinkError(f"the certificate file cannot be used: {what}", where=str(target.tls_cert), hint=hint)


def _uploaded(info: messages.DataInfo) -> Uploaded:
    times = info.interval
    return Uploaded(info.total_row_count, times and times.start_ns, times and times.end_ns, info.total_bytes)


def _schema_metadata(schema: pa.Schema, key: bytes = _USER_METADATA) -> dict[str, Any]:
    """Return the user metadata of a sequence or topic as servers before 0.7 send it, or another key."""
    text = (schema.metadata or {}).get(key, b"{}")
    try:
        metadata = json.loads(text)
    except ValueError as error:
        raise Malformed(f"{key.decode()}: {error}") from error
    return metadata if isinstance(metadata, dict) else {}


def _layout(name: object) -> SerializationFormat:
    layouts = (layout for layout in SerializationFormat if layout.value == name)
    return next(layouts, SerializationFormat.DEFAULT)


def _bytes(metadata: bytes | str) -> bytes:
    return metadata.encode() if isinstance(metadata, str) else metadata
