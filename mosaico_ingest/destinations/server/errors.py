"""Errors of a server or of the connection to it; messages never contain an API key."""

from __future__ import annotations

import socket
import ssl
from dataclasses import dataclass, field
from typing import NoReturn

from mosaico_ingest.errors import IngestError, SinkError, SinkUnavailable
from mosaico_ingest.protocol.errors import Condition, condition_of, text_of
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.protocol.names import key_problem

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
