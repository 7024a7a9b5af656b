"""This file is the platform's API keys: `msco_`, 32 characters, and a checksum that finds typing mistakes."""

from __future__ import annotations

import re
import secrets
import string
import zlib

__all__ = ["key_problem", "new_key"]

_ALPHABET = string.ascii_lowercase + string.digits
_FORM = re.compile(r"msco_([a-z0-9]{32})_([0-9a-f]{8})")


def new_key() -> str:
    """Return a new random key."""
    secret = "".join(secrets.choice(_ALPHABET) for _ in range(32))
    return f"msco_{secret}_{_checksum(secret)}"


def key_problem(key: str) -> str | None:
    """Return why this can be no key, without repeating it; None where it can."""
    form = _FORM.fullmatch(key)
    if form is None:
        return "it is not msco_<32 letters or digits>_<8 hex digits>"
    if form.group(2) != _checksum(form.group(1)):
        return "its checksum does not fit, so a character is wrong"
    return None


def _checksum(secret: str) -> str:
    return f"{zlib.crc32(secret.encode()):08x}"
