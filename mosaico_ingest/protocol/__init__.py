"""The Mosaico protocol: typed requests and responses, and their encoding.

Client (`destinations.server`) and server (`serve`) share the message bodies, actions with their permissions, and error
conditions, and the rules of this module: names of sequences and topics, metadata keys and API keys. The package must not
depend on either side.
"""

from __future__ import annotations

import json
import re
import secrets
import string
import zlib
from collections.abc import Mapping
from typing import Any

from mosaico_ingest.errors import SinkError

_MAX_SEQUENCE_NAME, _MAX_TOPIC_NAME = 255, 4096
_FORBIDDEN = re.compile(r"[^\x21-\x7e]|[!\"'*£$%&.:]")
_MAX_DEPTH = 64
"""Maximum nesting depth of metadata."""
_METADATA_KEY = re.compile(r"[A-Za-z0-9 _-]+")
_ALLOWED = "ASCII without blanks and without ! \" ' * $ % & . :"


def check_sequence_name(name: str) -> str:
    """Return the name of a sequence, or raise SinkError if it is too long or has a character that is not allowed."""
    if not name:
        raise SinkError("the sequence name is empty", hint="set sequence.name")
    _check_length(name, _MAX_SEQUENCE_NAME, kind="sequence")
    _check_characters(name, _FORBIDDEN.search(name), kind="sequence", allowed=f"{_ALLOWED} /")
    _check_characters(name, re.search("/", name), kind="sequence", allowed=f"{_ALLOWED} /")
    return name


def is_sequence_name(name: str) -> bool:
    """Return whether `check_sequence_name` accepts a name."""
    return 0 < len(name) <= _MAX_SEQUENCE_NAME and "/" not in name and _FORBIDDEN.search(name) is None


def check_topic_name(name: str) -> str:
    """Return the name of a topic with its leading slash, or raise SinkError if it is not allowed."""
    _check_characters(name, _FORBIDDEN.search(name), kind="topic", allowed=_ALLOWED)
    _check_length(name, _MAX_TOPIC_NAME, kind="topic")
    path = name.removeprefix("/")
    if not all(path.split("/")):
        raise SinkError(f"topic name {name!r} has an empty part", hint="rename it in topic_settings")
    return f"/{path}"


def _check_length(name: str, limit: int, *, kind: str) -> None:
    if len(name) > limit:
        hint = "set sequence.name" if kind == "sequence" else "rename it in topic_settings"
        raise SinkError(
            f"{kind} name {name[:20]!r}… has {len(name)} characters; the limit is {limit}", hint=hint
        )


def _check_characters(name: str, forbidden: re.Match[str] | None, *, kind: str, allowed: str) -> None:
    if forbidden is not None:
        hint = "set sequence.name" if kind == "sequence" else "rename it in topic_settings"
        raise SinkError(f"{kind} name {name!r} contains {forbidden.group()!r}; allowed: {allowed}", hint=hint)


def check_metadata(metadata: Mapping[str, Any], *, where: str) -> str:
    """Return the metadata as JSON, or raise SinkError with the path of an invalid key or value."""
    if _exceeds_depth(metadata, _MAX_DEPTH):
        raise SinkError(f"metadata is nested deeper than {_MAX_DEPTH} levels", where=where, hint="flatten it")
    for path, key in _keys(metadata, ""):
        if not _METADATA_KEY.fullmatch(key) or "--" in key:
            raise SinkError(
                f"metadata key {path!r} is invalid; allowed: letters, digits, blanks, _ and single -",
                where=where,
            )
    try:
        text = json.dumps(metadata, allow_nan=False)
        json.dumps(metadata, ensure_ascii=False).encode()  # most JSON readers reject unpaired surrogates
    except (TypeError, ValueError) as err:
        raise SinkError(f"metadata is not JSON: {err}", where=where) from err
    return text


def _exceeds_depth(value: object, levels: int) -> bool:
    if not isinstance(value, Mapping | list | tuple):
        return False
    inner = value.values() if isinstance(value, Mapping) else value
    return levels == 0 or any(_exceeds_depth(child, levels - 1) for child in inner)


def _keys(value: object, path: str) -> list[tuple[str, str]]:
    """Return every key of nested metadata with its path."""
    if isinstance(value, Mapping):
        pairs: list[tuple[str, str]] = []
        for key, child in value.items():
            inner = f"{path}.{key}" if path else str(key)
            pairs += [(inner, str(key)), *_keys(child, inner)]
        return pairs
    if isinstance(value, list | tuple):
        return [pair for i, child in enumerate(value) for pair in _keys(child, f"{path}[{i}]")]
    return []


_ALPHABET = string.ascii_lowercase + string.digits
_API_KEY = re.compile(r"msco_([a-z0-9]{32})_([0-9a-f]{8})")


def new_key() -> str:
    """Return a new random API key."""
    secret = "".join(secrets.choice(_ALPHABET) for _ in range(32))
    return f"msco_{secret}_{_checksum(secret)}"


def key_fingerprint(key: str) -> str:
    """Return the fingerprint of an API key: its last part, by which clients identify it."""
    return key.rpartition("_")[2]


def key_problem(key: str) -> str | None:
    """Return why a text is not a valid API key, or None; the reason does not contain the text."""
    match = _API_KEY.fullmatch(key)
    if match is None:
        return "it is not msco_<32 letters or digits>_<8 hex digits>"
    if match.group(2) != _checksum(match.group(1)):
        return "its checksum does not match, so at least one character is wrong"
    return None


def _checksum(secret: str) -> str:
    return f"{zlib.crc32(secret.encode()):08x}"
