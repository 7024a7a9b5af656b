"""API keys of a served store: the key file, and the check of every call.

A key has 165 random bits, so its plain hash tells nobody the key.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path

import pyarrow.flight as fl
from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import API_KEY_HEADER, Permission
from mosaico_ingest.protocol.names import key_problem, new_key
from mosaico_ingest.serve.errors import Refusal

__all__ = [
    "MIDDLEWARE",
    "KeyCheck",
    "Keyring",
    "StoredKey",
    "require",
]


class StoredKey(BaseModel):
    """What is kept of a key."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sha256: str
    permission: Permission
    description: str = ""
    created: datetime
    expires: datetime | None = None
    """None: never."""


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int = 1
    keys: tuple[StoredKey, ...] = ()


class Keyring:
    """The keys in the file at `path`; a file that is not there holds none."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._keys = {key.sha256: key for key in self._load().keys}

    @property
    def keys(self) -> tuple[StoredKey, ...]:
        """What is kept of every key."""
        return tuple(self._keys.values())

    def add(self, permission: Permission, *, description: str = "", expires: datetime | None = None) -> str:
        """Make a key, keep its hash in the file, and return it; it cannot be recovered afterwards.

        Raises:
            SinkError: The file cannot be written, or `expires` has no time zone.
        """
        if expires is not None and expires.tzinfo is None:
            raise SinkError(
                f"{expires.isoformat()} has no time zone", hint="add one, as in 2026-12-31T00:00:00Z"
            )
        key = new_key()
        now = datetime.now(timezone.utc)
        stored = StoredKey(
            sha256=_hash(key), permission=permission, description=description, created=now, expires=expires
        )
        self._keys = {held.sha256: held for held in self._load().keys} | {stored.sha256: stored}
        self._save()
        return key

    def permission_of(self, key: str) -> Permission:
        """Return what the key may do.

        Raises:
            PermissionError: It is malformed, unknown or expired; the text says which, without the key.
        """
        problem = key_problem(key)
        if problem is not None:
            raise PermissionError(f"the API key is malformed: {problem}")
        stored = self._keys.get(_hash(key))
        if stored is None:
            raise PermissionError("the API key is unknown")
        if stored.expires is not None and stored.expires <= datetime.now(timezone.utc):
            raise PermissionError(f"the API key expired on {stored.expires.isoformat()}")
        return stored.permission

    def _load(self) -> _File:
        try:
            text = self.path.read_text("utf-8") if self.path.exists() else "{}"
        except OSError as err:
            raise SinkError(f"cannot be read: {err.strerror}", where=str(self.path)) from err
        try:
            return _File.model_validate_json(text)
        except ValidationError as err:
            first = err.errors(include_url=False, include_input=False)[0]
            raise SinkError(f"the file is no key ring: {first['msg']}", where=str(self.path)) from err

    def _save(self) -> None:
        content = _File(keys=self.keys).model_dump_json(indent=2)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(
                dir=self.path.parent, prefix=self.path.name
            )  # readable by its owner only
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(content)
            Path(name).replace(self.path)
        except OSError as err:
            raise SinkError(f"cannot be written: {err.strerror}", where=str(self.path)) from err


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()


MIDDLEWARE = "api-key"


class _Granted(fl.ServerMiddleware):
    """What the caller may do."""

    def __init__(self, permission: Permission) -> None:
        super().__init__()
        self.permission = permission


class KeyCheck(fl.ServerMiddlewareFactory):
    """Lets calls in whose key is on the ring; without a ring, all of them with every permission."""

    def __init__(self, keyring: Keyring | None) -> None:
        super().__init__()
        self._keyring = keyring

    def start_call(  # pyright: ignore[reportIncompatibleMethodOverride] - a list may hold both kinds of text
        self,
        info: fl.CallInfo,  # noqa: ARG002 - Flight gives it
        headers: Mapping[str, list[str | bytes]],
    ) -> _Granted:
        """Return what the key in the headers may do, or refuse the call."""
        if self._keyring is None:
            return _Granted(Permission.MANAGE)
        given = headers.get(API_KEY_HEADER)
        if not given:
            raise as_flight_error(Condition.UNAUTHENTICATED, "this server needs an API key")
        key = given[0].decode("ascii", "replace") if isinstance(given[0], bytes) else given[0]
        try:
            return _Granted(self._keyring.permission_of(key))
        except PermissionError as err:
            raise as_flight_error(Condition.UNAUTHENTICATED, str(err)) from err


def require(context: fl.ServerCallContext, needed: Permission) -> None:
    """Refuse the call unless its key includes `needed`."""
    granted = context.get_middleware(MIDDLEWARE)
    if not isinstance(granted, _Granted):
        raise Refusal(Condition.UNAUTHENTICATED, "this server needs an API key")
    if not granted.permission.includes(needed):
        raise Refusal(
            Condition.PERMISSION,
            f"permission denied: this needs a key with {needed.value}, this one has {granted.permission.value}",
        )
