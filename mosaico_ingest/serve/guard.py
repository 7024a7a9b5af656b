"""The guard of a server: API keys, limits, the audit log, and the statuses of refused calls.

The key file holds hashes. A key has 165 random bits, so its unsalted hash does not reveal it.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import pyarrow as pa
import pyarrow.flight as fl
from msgspec import Struct
from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.protocol import key_fingerprint, key_problem, new_key
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import API_KEY_HEADER, VERSION, Malformed, Permission

_LOG = logging.getLogger(__name__)
MIDDLEWARE = "api-key"
"""The name under which Flight stores the result of the key check."""
MAX_REFUSED_SCHEMAS = 500
"""Number of refused GetSchema calls per key and hour. Flight leaks about 1.7 kB for each of them."""
_HOUR_S = 3600.0
MAX_REQUEST_BYTES = 256 << 20
"""Default size of the largest body of an action and of the largest message of an upload, in bytes."""
_BURST_S = 10.0
"""Seconds of the permitted rate that a caller may use immediately after a pause."""
_HEALTH_TIMEOUT_S = 3.0
_MAX_CALLERS = 10_000
"""Number of callers above which callers without recent calls are forgotten."""
_MAX_TEXT = 300
"""Maximum length of names and errors in the audit log."""


class Refusal(Exception):  # noqa: N818 - named after the status that it carries
    """The refusal of a call with a status of the protocol."""

    def __init__(self, condition: Condition, text: str) -> None:
        super().__init__(text)
        self.condition = condition


class Deadline:
    """The time limit of one call, which long calls check between their steps."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._end_s = time.monotonic() + seconds

    def check(self) -> None:
        """Refuse the call if its time limit has passed."""
        if time.monotonic() > self._end_s:
            raise Refusal(Condition.TIMED_OUT, f"the request exceeded its time limit of {self._seconds:g} s")


@contextmanager
def refuse_invalid() -> Generator[None, None, None]:
    """Refuse the call as invalid if a check of names, metadata or columns fails in the block."""
    try:
        yield
    except (SinkError, pa.ArrowException) as err:
        raise Refusal(Condition.INVALID, str(err)) from err


@contextmanager
def translate_errors() -> Generator[None, None, None]:
    """Raise every error of the block as the exception that Flight sends to the client.

    Only exceptions of Flight may leave a call. Arrow sends the traceback of other exceptions, which contains paths, to
    the client, and never frees them.
    """
    try:
        yield
    except fl.FlightError:
        raise
    except Exception as err:  # noqa: BLE001 - no other exception may reach Flight
        raise as_flight_error(*_condition_of(err)) from None


def _condition_of(err: Exception) -> tuple[Condition, str]:
    if isinstance(err, Refusal):
        return err.condition, str(err)
    if isinstance(err, NotInStore):
        return Condition.NOT_FOUND, f"not found: {err.what}"
    if isinstance(err, SequenceExists):
        return Condition.EXISTS, f"{err.where} already exists"
    conditions = {
        Malformed: Condition.INVALID,
        SinkUnavailable: Condition.UNAVAILABLE,
        SinkError: Condition.INTERNAL,
    }
    for kind, condition in conditions.items():
        if isinstance(err, kind):
            return condition, str(err)
    _LOG.exception("a call failed")
    return Condition.INTERNAL, f"unexpected {type(err).__name__}"


class StoredKey(BaseModel):
    """The stored properties of a key."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sha256: str
    fingerprint: str = ""
    """The last part of the key, by which clients identify it; empty for keys of early versions."""
    permission: Permission
    description: str = ""
    created: datetime
    expires: datetime | None = None
    """None if the key does not expire."""


class _KeyFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    keys: tuple[StoredKey, ...] = ()


class Keyring:
    """The API keys in the file at `path`, which is reloaded when it changes; a missing file contains no keys."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = Lock()
        self._state: tuple[int, int, int] | None = None
        self._keys: dict[str, StoredKey] = {}
        self._reload()

    @property
    def keys(self) -> tuple[StoredKey, ...]:
        """The stored properties of every key."""
        self._reload()
        return tuple(self._keys.values())

    def add(self, permission: Permission, *, description: str = "", expires: datetime | None = None) -> str:
        """Create a key, add its hash to the file, and return the key, which cannot be recovered later.

        Raises:
            SinkError: The file cannot be written, or `expires` has no time zone.
        """
        if expires is not None and expires.tzinfo is None:
            raise SinkError(
                f"{expires.isoformat()} has no time zone", hint="add one, as in 2026-12-31T00:00:00Z"
            )
        key = new_key()
        stored = StoredKey(
            sha256=_hash(key),
            fingerprint=key_fingerprint(key),
            permission=permission,
            description=description,
            created=datetime.now(timezone.utc),
            expires=expires,
        )
        with self._lock:
            self._save((*self._load().keys, stored))
        self._reload()
        return key

    def find(self, fingerprint: str) -> StoredKey | None:
        """Return the key with this fingerprint, or None."""
        return next((key for key in self.keys if fingerprint and key.fingerprint == fingerprint), None)

    def revoke(self, fingerprint: str) -> bool:
        """Remove the key with this fingerprint; return False if there is none.

        Raises:
            SinkError: The file cannot be written.
        """
        with self._lock:
            keys = self._load().keys
            remaining = tuple(key for key in keys if not fingerprint or key.fingerprint != fingerprint)
            if len(remaining) < len(keys):
                self._save(remaining)
        self._reload()
        return len(remaining) < len(keys)

    def permission_of(self, key: str) -> Permission:
        """Return the permission of a key.

        Raises:
            PermissionError: The key is malformed, unknown or expired; the message does not contain it.
        """
        problem = key_problem(key)
        if problem is not None:
            raise PermissionError(f"the API key is malformed: {problem}")
        self._reload()
        stored = self._keys.get(_hash(key))
        if stored is None:
            raise PermissionError("the API key is unknown or revoked")
        if stored.expires is not None and stored.expires <= datetime.now(timezone.utc):
            raise PermissionError(f"the API key expired on {stored.expires.isoformat()}")
        return stored.permission

    def _reload(self) -> None:
        """Read the file if it has changed since it was read."""
        with self._lock:
            state = self._file_state()
            if state != self._state or state is None:
                self._keys = {key.sha256: key for key in self._load().keys}
                self._state = state

    def _file_state(self) -> tuple[int, int, int] | None:
        try:
            stat = self.path.stat()
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_size, stat.st_ino

    def _load(self) -> _KeyFile:
        try:
            text = self.path.read_text("utf-8") if self.path.exists() else "{}"
        except OSError as err:
            raise SinkError(f"the key file cannot be read: {err.strerror}", where=str(self.path)) from err
        try:
            return _KeyFile.model_validate_json(text)
        except ValidationError as err:
            first = err.errors(include_url=False, include_input=False)[0]
            key = ".".join(map(str, first["loc"]))
            problem = f"{key}: {first['msg']}" if key else first["msg"]
            raise SinkError(f"the file is not a key file: {problem}", where=str(self.path)) from err

    def _save(self, keys: tuple[StoredKey, ...]) -> None:
        content = _KeyFile(keys=keys).model_dump_json(indent=2)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # `mkstemp` creates a file that only its owner can read
            handle, name = tempfile.mkstemp(dir=self.path.parent, prefix=self.path.name)
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(content)
            Path(name).replace(self.path)
        except OSError as err:
            raise SinkError(f"the key file cannot be written: {err.strerror}", where=str(self.path)) from err


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()


class _Granted(fl.ServerMiddleware):
    """The caller: its key and permission, and the times at which GetSchema calls of its key were refused."""

    def __init__(self, key: str, permission: Permission, refused_schemas: deque[float]) -> None:
        super().__init__()
        self.fingerprint = key_fingerprint(key) if key else ""
        self.permission = permission
        self.refused_schemas = refused_schemas


class KeyCheck(fl.ServerMiddlewareFactory):
    """The check that accepts calls with a key of the key ring; without a key ring, every call has every permission.

    It also refuses the GetSchema calls of a key that has had too many refused: only an error of this check costs no
    memory.
    """

    def __init__(self, keyring: Keyring | None, refused: Callable[[str, fl.FlightError], None]) -> None:
        """Create the check; `refused` receives the name of each refused call and the error."""
        super().__init__()
        self._keyring = keyring
        self._refused = refused
        self._refused_schemas: defaultdict[str, deque[float]] = defaultdict(
            lambda: deque[float](maxlen=MAX_REFUSED_SCHEMAS)
        )

    def start_call(  # pyright: ignore[reportIncompatibleMethodOverride] - a list may contain text and bytes
        self, info: fl.CallInfo, headers: Mapping[str, list[str | bytes]]
    ) -> _Granted:
        """Return the permission of the key in the headers, or refuse the call."""
        try:
            return self._granted(info, headers)
        except fl.FlightError as error:
            self._refused(info.method.name.lower(), error)
            raise

    def _granted(self, info: fl.CallInfo, headers: Mapping[str, list[str | bytes]]) -> _Granted:
        key = self._key_of(headers)
        permission = Permission.MANAGE if self._keyring is None else self._permission_of(self._keyring, key)
        refused = self._refused_schemas[key]
        is_full = len(refused) == refused.maxlen and time.monotonic() - refused[0] < _HOUR_S
        if is_full and info.method is fl.FlightMethod.GET_SCHEMA:
            raise as_flight_error(
                Condition.UNAVAILABLE, f"{len(refused)} calls of GetSchema were refused within an hour"
            )
        return _Granted(key, permission, refused)

    def _key_of(self, headers: Mapping[str, list[str | bytes]]) -> str:
        """Return the key in the headers, or an empty text if the server has no keys."""
        if self._keyring is None:
            return ""
        values = headers.get(API_KEY_HEADER)
        if not values:
            raise as_flight_error(Condition.UNAUTHENTICATED, "this server requires an API key")
        return values[0].decode("ascii", "replace") if isinstance(values[0], bytes) else values[0]

    def _permission_of(self, keyring: Keyring, key: str) -> Permission:
        try:
            return keyring.permission_of(key)
        except PermissionError as err:
            raise as_flight_error(Condition.UNAUTHENTICATED, str(err)) from None
        except SinkError as err:
            raise as_flight_error(Condition.UNAVAILABLE, err.what) from None


def fingerprint_of(context: fl.ServerCallContext) -> str:
    """Return the part of the caller's key that identifies it, or an empty text if the server has no keys."""
    granted = context.get_middleware(MIDDLEWARE)
    return granted.fingerprint if isinstance(granted, _Granted) else ""


def count_refused_schema(context: fl.ServerCallContext) -> None:
    """Count a refused GetSchema call of the caller's key."""
    granted = context.get_middleware(MIDDLEWARE)
    if isinstance(granted, _Granted):
        granted.refused_schemas.append(time.monotonic())


def require(context: fl.ServerCallContext, needed: Permission) -> None:
    """Refuse the call unless the permission of its key includes `needed`."""
    granted = context.get_middleware(MIDDLEWARE)
    if not isinstance(granted, _Granted):
        raise Refusal(Condition.UNAUTHENTICATED, "this server requires an API key")
    if not granted.permission.includes(needed):
        raise Refusal(
            Condition.PERMISSION,
            f"permission denied: the call needs a key with {needed.value}, this key has {granted.permission.value}",
        )


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
