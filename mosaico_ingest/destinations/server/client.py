"""A connection to a Mosaico server: handshake, actions, queries and uploads, with deadlines."""

from __future__ import annotations

import re
import ssl
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from contextlib import contextmanager, suppress
from ipaddress import ip_address
from typing import Any, TypeVar, cast

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.flight as fl
from msgspec import Struct

from mosaico_ingest.destinations.server.errors import (
    Address,
    Refused,
    check_tls,
    late,
    reraise,
)
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.job.values import ServerTarget
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition, condition_of
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

__all__ = [
    "DeadlinePassed",
    "PlatformClient",
    "Uploaded",
    "connect",
    "in_thread",
    "within",
]

_Returned = TypeVar("_Returned")

DeadlinePassed = FutureTimeout
"""The call has not ended in time; its thread goes on, since nothing can end it but the server."""


def within(seconds: float, call: Callable[[], _Returned]) -> _Returned:
    """Return what the call returns, or raise what it raises.

    Raises:
        DeadlinePassed: It takes longer.
    """
    return in_thread(call).result(seconds)


def in_thread(call: Callable[[], _Returned]) -> Future[_Returned]:
    """Run the call on a thread that does not keep the process."""
    outcome: Future[_Returned] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as error:  # noqa: BLE001 - a thread's border: raised again where the result is asked for
            outcome.set_exception(error)

    threading.Thread(target=work, name="mosaico-ingest-call", daemon=True).start()
    return outcome


_ANSWER_S = 120.0
_MARGIN_S = 5.0
"""By then gRPC's own limit has spoken, where a call has one."""
_CLOSE_S = 1.0
_DELAYS_S = (0.2, 0.6, 1.8)
_CHANNEL: list[tuple[str, Any]] = [
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1000),
]
_HOST = re.compile(r"[A-Za-z0-9._-]+|[0-9A-Fa-f:.]+%\w+")
"""A name, or an IPv6 address with its interface."""
_UNKNOWN = frozenset({Condition.UNIMPLEMENTED, Condition.INVALID, Condition.NOT_FOUND})

_Question = TypeVar("_Question", bound=Body)
_Answer = TypeVar("_Answer", bound=Body)
_Result = TypeVar("_Result")


class Uploaded(Struct, frozen=True):
    """What a server says it holds of a topic."""

    rows: int
    start_ns: int | None
    end_ns: int | None
    """Inclusive."""
    stored_bytes: int


class PlatformClient:
    """A server that answered; made by `connect`."""

    def __init__(self, flight: fl.FlightClient, address: Address, codec: Codec, answer_s: float) -> None:
        self.address = address
        self.version = "unknown"
        self.message_bytes = messages.DEFAULT_DECODE_BYTES
        """The most the server takes in one message."""
        self._flight = flight
        self._codec = codec
        self._answer_s = answer_s
        key = [(API_KEY_HEADER.encode(), address.key.encode())] if address.key else []
        headers = cast("list[tuple[str, str]]", key)  # what the stubs want; Flight wants bytes
        self._upload = fl.FlightCallOptions(headers=headers)
        self._answer = fl.FlightCallOptions(headers=headers, timeout=answer_s)

    def handshake(self) -> None:
        """Ask what the server is and takes; one that does not know `info` is asked for its version.

        Raises:
            SinkError: There is no Mosaico server that lets this key in.
        """
        try:
            info = self.act(INFO, messages.Empty())
        except Refused as refusal:
            if refusal.condition not in _UNKNOWN:
                raise
            self.version = self._old_version()
        else:
            self.version = info.version
            self.message_bytes = info.config.grpc_max_decode_message_size

    def act(self, action: Action[_Question, _Answer], question: _Question) -> _Answer:
        """Ask the server to do something.

        Raises:
            Refused: It said no.
            SinkUnavailable: It did not answer.
        """

        def call() -> bytes:
            request = fl.Action(action.name, self._codec.encode(question))
            return b"".join(
                result.body.to_pybytes() for result in self._flight.do_action(request, self._answer)
            )

        data = self._call(call, action.name, action.permission, repeatable=action.repeatable)
        with self._understood(action.name):
            return self._codec.decode_answer(action, data)

    def find(self, sequence: str) -> messages.SequenceInfo | None:
        """Return what the server knows of a sequence, None where there is none."""
        try:
            info = self._info(sequence)
        except Refused as refusal:
            if refusal.condition is Condition.NOT_FOUND:
                return None
            raise
        with self._understood("get_flight_info"):
            return self._codec.decode(messages.SequenceInfo, _bytes(info.app_metadata) or b"{}")

    def uploaded(self, sequence: str) -> dict[str, Uploaded]:
        """Return what the server holds of each topic of a sequence, by locator, as far as it says so."""
        found = (self._about(endpoint) for endpoint in self._info(sequence).endpoints)
        return {about.resource_locator: _uploaded(about.data_info) for about in found if about is not None}

    def counted(self, locator: str) -> Uploaded:
        """Return what the server holds of a topic by reading it, for servers that do not say."""
        ticket = self._info(locator).endpoints[0].ticket
        reader = self._call(
            lambda: self._flight.do_get(ticket, self._upload).to_reader(),
            "do_get",
            Permission.READ,
            repeatable=True,
        )
        return self._counted(reader)

    def put(self, put: messages.Put, schema: pa.Schema) -> fl.FlightStreamWriter:
        """Begin an upload."""
        descriptor = fl.FlightDescriptor.for_command(self._codec.encode(put))

        def call() -> fl.FlightStreamWriter:
            return self._flight.do_put(descriptor, schema, self._upload)[0]

        return self._call(call, "do_put", Permission.WRITE, repeatable=False)

    @contextmanager
    def _understood(self, doing: str) -> Generator[None, None, None]:
        try:
            yield
        except Malformed as error:
            raise SinkError(
                f"the answer to {doing} is not understood: {error}",
                where=str(self.address),
                hint="is it a Mosaico server of version 0.5 to 0.7?",
            ) from error

    def _info(self, locator: str) -> fl.FlightInfo:
        question = messages.GetInfo(resource_locator=locator)
        descriptor = fl.FlightDescriptor.for_command(self._codec.encode(question))
        return self._call(
            lambda: self._flight.get_flight_info(descriptor, self._answer),
            "get_flight_info",
            Permission.READ,
            repeatable=True,
        )

    def _about(self, endpoint: fl.FlightEndpoint) -> messages.TopicInfo | None:
        try:
            return self._codec.decode(messages.TopicInfo, _bytes(endpoint.app_metadata))
        except Malformed:
            return None

    def _counted(self, reader: pa.RecordBatchReader) -> Uploaded:
        rows = size = 0
        bounds: list[int] = []
        while (batch := self._once(lambda: next(reader, None), "do_get", Permission.READ)) is not None:
            span = pc.min_max(batch.column("timestamp_ns"))
            rows += batch.num_rows
            size += batch.nbytes
            bounds += [at for at in (span["min"].as_py(), span["max"].as_py()) if at is not None]
        return Uploaded(rows, min(bounds, default=None), max(bounds, default=None), size)

    def _old_version(self) -> str:
        try:
            return self.act(VERSION, messages.Empty()).version
        except Refused as refusal:
            if refusal.condition in _UNKNOWN:
                raise SinkError(
                    "a Flight server answers, but it is no Mosaico server",
                    where=str(self.address),
                    hint="check target.host and target.port",
                ) from refusal
            raise

    def _call(
        self, call: Callable[[], _Result], doing: str, needs: Permission, *, repeatable: bool
    ) -> _Result:
        """Call, and again after a while where the server was away and a repetition does no harm."""
        for delay_s in _DELAYS_S if repeatable else ():
            try:
                return self._once(call, doing, needs)
            except SinkUnavailable as error:
                if _was_slow(error):
                    raise
            time.sleep(delay_s)
        return self._once(call, doing, needs)

    def _once(self, call: Callable[[], _Result], doing: str, needs: Permission) -> _Result:
        try:
            return within(self._answer_s + _MARGIN_S, call)
        except DeadlinePassed as error:
            raise late(self.address, doing) from error
        except pa.ArrowException as error:
            reraise(error, self.address, doing=doing, needs=needs)


@contextmanager
def connect(
    target: ServerTarget, *, codec: Codec = JSON, answer_s: float = _ANSWER_S, handshake: bool = True
) -> Generator[PlatformClient, None, None]:
    """Connect to a server, shake hands unless it is known already, and let go of it at the end.

    Raises:
        SinkError: There is no server, or it does not let us in; says which.
    """
    address = _address(target)
    if address.tls:
        check_tls(address)
    flight = fl.FlightClient(str(address), tls_root_certs=address.roots, generic_options=_CHANNEL)
    try:
        client = PlatformClient(flight, address, codec, answer_s)
        if handshake:
            client.handshake()
        yield client
    finally:
        with suppress(DeadlinePassed):
            within(_CLOSE_S, flight.close)  # it waits for calls under way, which may be stuck


def _was_slow(error: SinkUnavailable) -> bool:
    """Say whether the server was there and did not answer in time: asking again would only load it more."""
    cause = error.__cause__
    return isinstance(cause, DeadlinePassed) or condition_of(cause or error) is Condition.TIMED_OUT


def _address(target: ServerTarget) -> Address:
    key = target.api_key
    if key and not (key.isascii() and key.isprintable() and " " not in key):
        raise SinkError(
            "the API key has characters no key has", hint="check for blanks and line breaks around it"
        )
    _check_host(target.host)
    return Address(target.host, target.port, target.tls or target.tls_cert is not None, _roots(target), key)


def _check_host(host: str) -> None:
    """Raise SinkError for what cannot be a host, such as a URL or a host with its port."""
    with suppress(ValueError):
        ip_address(host)
        return
    if not host or not _HOST.fullmatch(host):
        raise SinkError(
            f"host {host!r} is neither a name nor an address",
            hint="give target.host without scheme and port, and target.port by itself",
        )


def _roots(target: ServerTarget) -> str | None:
    if target.tls_cert is None:
        return None
    try:
        roots = target.tls_cert.read_text("ascii", errors="ignore")  # bundles carry comments in any script
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cadata=roots)
    except (ssl.SSLError, ValueError):
        what, hint = "it holds no certificate", "PEM is wanted"
    except OSError as error:
        what, hint = error.strerror or str(error), "check target.tls_cert"
    else:
        return roots
    raise SinkError(f"the certificate file cannot be used: {what}", where=str(target.tls_cert), hint=hint)


def _uploaded(held: messages.DataInfo) -> Uploaded:
    span = held.interval
    return Uploaded(held.total_row_count, span and span.start_ns, span and span.end_ns, held.total_bytes)


def _bytes(metadata: bytes | str) -> bytes:
    return metadata.encode() if isinstance(metadata, str) else metadata
