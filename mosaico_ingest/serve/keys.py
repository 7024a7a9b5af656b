"""API keys of a served store: the key file, and the check of every call.

The file holds hashes. A key has 165 random bits, so its unsalted hash does not reveal it.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock
from typing import Literal

import pyarrow.flight as fl
from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol import key_fingerprint, key_problem, new_key
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import API_KEY_HEADER, Permission
from mosaico_ingest.serve.errors import Refusal

MIDDLEWARE = "api-key"
"""The name under which Flight stores the result of the key check."""


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


MAX_REFUSED_SCHEMAS = 500
"""Number of refused GetSchema calls per key and hour. Flight leaks about 1.7 kB for each of them."""
_HOUR_S = 3600.0


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
