"""This file says in one line what a server or the way to it refuses; a key is never part of what it says."""

from __future__ import annotations

import socket
import ssl
from dataclasses import dataclass, field
from typing import NoReturn

from mosaico_ingest.errors import IngestError, SinkError, SinkUnavailable
from mosaico_ingest.protocol.errors import Condition, condition_of, text_of
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.protocol.names import key_problem

__all__ = ["Address", "Refused", "add_hint", "check_tls", "late", "reraise"]

_PATIENCE_S = 3.0
_WRONG_NAME = frozenset({62, 64})
"""OpenSSL's verification results for a certificate of another host name or IP address."""
_NO_HTTP2 = "Failed parsing HTTP/2"
"""What gRPC says of a server that speaks another protocol, a web server for example."""
_KEY_HINT = "set target.api_key or MOSAICO_API_KEY"


class Refused(SinkError):  # noqa: N818 - the condition, as in `errors`
    """The server said no; `condition` is the kind of no."""

    def __init__(
        self, what: str, *, where: str | None = None, hint: str | None = None, condition: Condition
    ) -> None:
        super().__init__(what, where=where, hint=hint)
        self.condition = condition


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server is and how it is spoken to."""

    host: str
    port: int
    tls: bool
    roots: str | None = field(default=None, repr=False)
    """Certificates to trust, PEM; None: the system's."""
    key: str | None = field(default=None, repr=False)

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'grpc+tls' if self.tls else 'grpc'}://{host}:{self.port}"


def add_hint(error: IngestError, hint: str) -> None:
    """Let an error that is on its way say one thing more."""
    error.hint = f"{error.hint}; {hint}" if error.hint else hint


def check_tls(address: Address) -> None:
    """Raise SinkError where a server that answers cannot be trusted; gRPC would say so on the terminal, vaguely."""
    try:
        connection = socket.create_connection((address.host, address.port), timeout=_PATIENCE_S)
    except OSError:
        return  # perhaps gRPC knows a way, through a proxy; if not, `reraise` says why
    with connection:
        fault = _tls_fault(connection, address)
    if fault is not None:
        raise fault


def late(address: Address, doing: str) -> SinkUnavailable:
    """Return the error of a call that has not ended in time."""
    hint = "the server is slow or stuck"
    return SinkUnavailable(f"no answer to {doing} in time", where=str(address), hint=hint)


def reraise(error: Exception, address: Address, *, doing: str, needs: Permission) -> NoReturn:
    """Raise an error of Flight as one of our own.

    Raises:
        Refused: The server said no.
        SinkUnavailable: It did not answer; trying again may help.
        SinkError: It cannot be reached this way.
    """
    secret = address.key is not None and address.key in str(error)
    raise _explained(error, address, doing=doing, needs=needs) from (None if secret else error)


def _explained(error: Exception, address: Address, *, doing: str, needs: Permission) -> SinkError:
    condition, text = condition_of(error), text_of(error)
    if address.key:
        text = text.replace(address.key, "<the key>")
    where = str(address)
    if condition is Condition.UNAVAILABLE:
        return _diagnosed(address, text)
    if condition is Condition.TIMED_OUT:
        return late(address, doing)
    if condition in {Condition.UNAUTHENTICATED, Condition.PERMISSION}:
        what, hint = _about_key(address.key, condition, text, doing=doing, needs=needs)
        return Refused(what, where=where, hint=hint, condition=condition)
    return Refused(f"{doing} is refused: {text}", where=where, condition=condition)


def _about_key(
    key: str | None, condition: Condition, text: str, *, doing: str, needs: Permission
) -> tuple[str, str]:
    if not key:
        return "the server wants an API key", _KEY_HINT
    problem = key_problem(key)
    if problem:
        return f"the API key is refused: {problem}", _KEY_HINT
    if condition is Condition.PERMISSION:
        return f"the API key may not do {doing} ({text})", f"use a key with the permission {needs.value}"
    return f"the API key is refused ({text})", "ask for a new one"


def _diagnosed(address: Address, text: str) -> SinkError:
    """Return why there is no connection, found out by making one step by step."""
    where = str(address)
    try:
        connection = socket.create_connection((address.host, address.port), timeout=_PATIENCE_S)
    except socket.gaierror:
        return SinkError(f"no host is called {address.host!r}", where=where, hint="check target.host")
    except ConnectionRefusedError:
        hint = "check target.host and target.port, and that the server runs"
        return SinkUnavailable("nothing listens there", where=where, hint=hint)
    except OSError as error:
        why = error.strerror or f"no answer within {_PATIENCE_S:g} s"
        return SinkUnavailable(why, where=where, hint="check target.host and the network")
    with connection:
        found = _tls_fault(connection, address) if address.tls else _plain_fault(connection, address)
    if found is None and _NO_HTTP2 in text:
        hint = "check target.host and target.port"
        return SinkError("what answers there is no Mosaico server", where=where, hint=hint)
    return found or SinkUnavailable(f"the server does not answer: {text}", where=where, hint="try again")


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
        return SinkError("the server does not speak TLS", where=where, hint="set target.tls: false")
    except OSError:
        return None
    return None


def _plain_fault(connection: socket.socket, address: Address) -> SinkError | None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # nothing is sent: the question is only whether there is TLS
    context.set_alpn_protocols(["h2"])
    try:
        context.wrap_socket(connection, server_hostname=address.host).close()
    except OSError:
        return None
    hint = "set target.tls: true, or target.tls_cert"
    return SinkError("the server speaks TLS only", where=str(address), hint=hint)
