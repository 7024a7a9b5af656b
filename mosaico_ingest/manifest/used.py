"""This file is a manifest as a report may show it: with what it extends, as YAML, and without secrets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path as File

from mosaico_ingest.manifest.extends import KEY
from mosaico_ingest.manifest.load import read_manifest
from mosaico_ingest.manifest.source import Path, Value
from mosaico_ingest.manifest.text import to_yaml

__all__ = ["MASK", "manifest_text"]

MASK = "***"
_SECRET = re.compile(r"api_?key|password|token|secret", re.IGNORECASE)
_IN_TEXT = re.compile(
    r"(?<=://)[^/@\s]+(?=@)|msco_\w+|(?<=[?&])([^=&\s]*(?:key|password|token|secret)[^=&\s]*=)[^&\s]+",
    re.IGNORECASE,
)
"""Keys of our own form, and what a URL says before an `@` and in its query."""
_VARIABLE = re.compile(r"\$\{(\w+)(?:[^{}]*)\}")


def manifest_text(path: File) -> str:
    """Return a manifest that has what it extends; variables stay, and a comment says what is another file's.

    Raises:
        ManifestError: It cannot be read.
    """
    source = read_manifest(path)
    value = source.value
    if isinstance(value, dict):
        value = {key: inner for key, inner in value.items() if key != KEY}
    hidden = frozenset(name for text in _secrets(value) for name in _VARIABLE.findall(text))

    def remark(place: Path) -> str | None:
        span = source.span(place)
        return None if span.file == source.file else f"{span.file}:{span.line}"

    return to_yaml(_masked(value, hidden), remark)


def _secrets(value: Value) -> Iterator[str]:
    """Yield the texts of a document whose keys say that they are secret."""
    if isinstance(value, list):
        for inner in value:
            yield from _secrets(inner)
    elif isinstance(value, dict):
        for key, inner in value.items():
            if isinstance(inner, str) and _SECRET.search(str(key)):
                yield inner
            else:
                yield from _secrets(inner)


def _masked(value: Value, hidden: frozenset[str], *, secret: bool = False) -> Value:
    """Mask texts below a key that says so, whatever a variable of such a text defaults to, and what looks like a key."""
    if isinstance(value, list):
        return [_masked(inner, hidden, secret=secret) for inner in value]
    if isinstance(value, dict):
        return {
            key: _masked(inner, hidden, secret=secret or key in hidden or bool(_SECRET.search(str(key))))
            for key, inner in value.items()
        }
    if secret and value is not None:
        names = _VARIABLE.findall(value) if isinstance(value, str) else []
        return "".join(f"${{{name}}}" for name in names) or MASK
    return _IN_TEXT.sub(lambda found: (found[1] or "") + MASK, value) if isinstance(value, str) else value
