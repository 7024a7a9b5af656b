"""The guard of a server: its audit log, its rate limit and its limits of sizes."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct

from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import VERSION
from mosaico_ingest.serve.errors import Refusal, translate_errors
from mosaico_ingest.serve.keys import fingerprint_of

MAX_REQUEST_BYTES = 256 << 20
"""Default size of the largest body of an action and of the largest message of an upload, in bytes."""
_BURST_S = 10.0
"""Seconds of the permitted rate that a caller may use immediately after a pause."""
_HEALTH_TIMEOUT_S = 3.0
_MAX_CALLERS = 10_000
"""Number of callers above which callers without recent calls are forgotten."""
_MAX_TEXT = 300
"""Maximum length of names and errors in the audit log."""


class Limits(Struct, frozen=True):
    """The limits of a server for each caller: a key, or without keys an address."""

    requests_per_s: float | None = None
    """Mean number of calls per second; None for no limit."""
    request_bytes: int = MAX_REQUEST_BYTES
    """Size of the largest body of an action and of the largest message of an upload, in bytes."""
    upload_bytes: int | None = None
    """Size of the largest upload of a topic, in bytes; None for no limit."""


class AuditLog:
    """A file with one JSON object per line and call; None records nothing."""

    def __init__(self, path: Path | None) -> None:
        """Open the file, which only its owner can read if it is new.

        Raises:
            SinkError: The file cannot be written.
        """
        self._lock = threading.Lock()
        self._file: int | None = None
        if path is None:
            return
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        except OSError as error:
            raise SinkError(f"the audit log cannot be written: {error.strerror}", where=str(path)) from error

    def write(self, **entry: Any) -> None:  # noqa: ANN401 - any JSON
        """Append a line with the time and these values.

        Raises:
            Refusal: The line cannot be written. The call fails, because it would not be recorded.
        """
        if self._file is None:
            return
        now = datetime.now(timezone.utc).isoformat(timespec="microseconds").replace("+00:00", "Z")
        line = json.dumps({"time": now, **entry}).encode() + b"\n"
        try:
            with self._lock:
                os.write(self._file, line)
        except OSError as error:
            text = "the call cannot be recorded in the audit log"
            raise Refusal(Condition.UNAVAILABLE, text) from error


@dataclass(slots=True)
class Call:
    """The properties of a call that the audit log records."""

    name: str
    """`get`, `put`, `list_flights`, `get_flight_info`, `get_schema`, or the name of the action."""
    target: str = ""
    """The locator of the sequence or topic."""
    rows: int | None = None
    bytes: int | None = None
    """Size of the uploaded rows in memory."""


@dataclass(slots=True)
class _Bucket:
    """The calls that a caller may still make now; refilled at the permitted rate."""

    remaining: float
    updated_s: float


@dataclass(slots=True)
class Guard:
    """Checks the rate of calls, and records each call."""

    limits: Limits
    log: AuditLog
    _buckets: dict[str, _Bucket] = field(default_factory=dict[str, _Bucket])
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def call(self, context: fl.ServerCallContext, name: str) -> Generator[Call]:
        """Run a call: raise its errors as Flight errors, and record it at the end."""
        call, start_s, error = Call(name), time.monotonic(), ""
        key, peer = fingerprint_of(context), context.peer()
        with translate_errors():
            try:
                with translate_errors():
                    self._check_rate(key or peer.rpartition(":")[0])
                    yield call
            except fl.FlightError as refusal:
                error = _status(refusal)
                raise
            finally:
                self.log.write(
                    peer=peer,
                    key=key or None,
                    call=call.name[:_MAX_TEXT],
                    target=call.target[:_MAX_TEXT],
                    status=error or "ok",
                    rows=call.rows,
                    bytes=call.bytes,
                    seconds=round(time.monotonic() - start_s, 6),
                )

    def refused(self, name: str, error: fl.FlightError) -> None:
        """Record a call that the check of its key refused, before its address is known."""
        with translate_errors():
            self.log.write(peer=None, key=None, call=name, target="", status=_status(error))

    def check_size(self, size: int, what: str) -> None:
        """Refuse a request of this size in bytes if it exceeds the limit."""
        if size > self.limits.request_bytes:
            text = f"{what} has {size} bytes; this server accepts {self.limits.request_bytes}"
            raise Refusal(Condition.INVALID, text)

    def add_upload(self, call: Call, rows: int, size: int) -> None:
        """Count a message of an upload, or refuse the upload if it exceeds a limit."""
        self.check_size(size, "a message of the upload")
        call.rows, call.bytes = (call.rows or 0) + rows, (call.bytes or 0) + size
        if self.limits.upload_bytes is not None and call.bytes > self.limits.upload_bytes:
            text = f"the upload has more than {self.limits.upload_bytes} bytes, the limit of this server"
            raise Refusal(Condition.INVALID, text)

    def _check_rate(self, caller: str) -> None:
        rate = self.limits.requests_per_s
        if rate is None:
            return
        capacity, now_s = max(1.0, rate * _BURST_S), time.monotonic()
        with self._lock:
            bucket = self._buckets.get(caller)
            if bucket is None:
                self._forget_idle(now_s)
                bucket = self._buckets[caller] = _Bucket(capacity, now_s)
            bucket.remaining = min(capacity, bucket.remaining + (now_s - bucket.updated_s) * rate)
            bucket.updated_s = now_s
            if bucket.remaining >= 1:
                bucket.remaining -= 1
                return
            wait_s = (1 - bucket.remaining) / rate
        raise Refusal(
            Condition.UNAVAILABLE, f"more than {rate:g} calls per second; try again in {wait_s:.1f} s"
        )

    def _forget_idle(self, now_s: float) -> None:
        if len(self._buckets) >= _MAX_CALLERS:
            self._buckets = {
                name: bucket for name, bucket in self._buckets.items() if now_s - bucket.updated_s < _BURST_S
            }


def responds(location: str) -> bool:
    """Return whether a server responds at a location such as `grpc://127.0.0.1:6726`, with or without a key."""
    options = fl.FlightCallOptions(timeout=_HEALTH_TIMEOUT_S)
    try:
        with fl.connect(location, disable_server_verification=location.startswith("grpc+tls")) as client:
            list(client.do_action(fl.Action(VERSION.name, b"{}"), options))
    except fl.FlightUnauthenticatedError:
        return True
    except pa.ArrowException:
        return False
    return True


def _status(error: fl.FlightError) -> str:
    """Return the condition of an error and its first line, such as `not found: …`."""
    return str(error).partition("\n")[0][:_MAX_TEXT] or type(error).__name__
