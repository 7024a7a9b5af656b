"""This file is who may do what: a JSON file of API keys, of which only the SHA-256 is kept.

A key has 165 random bits, so its plain hash tells nobody the key.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from datetime import datetime, timezone
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.errors import SinkError
from mosaico_ingest.wire.actions import Permission
from mosaico_ingest.wire.keys import key_problem, new_key

__all__ = ["Keyring", "StoredKey"]


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
