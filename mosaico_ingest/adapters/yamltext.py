"""This file writes plain values as YAML on one line, so that they read back as they are."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from mosaico_ingest.manifest.scalars import resolve_plain

__all__ = ["flow", "key", "word"]


def key(name: str) -> str:
    """Return a mapping's key, quoted where it would not be read as text."""
    return name if name.isidentifier() and resolve_plain(name) == (name, None) else json.dumps(name)


def word(text: str) -> str:
    """Return an expression, quoted where it would not be read as text."""
    return text if resolve_plain(text) == (text, None) else json.dumps(text)


def flow(value: Any) -> str:  # noqa: ANN401 - whatever a message holds
    """Return a value in flow style; bytes become a list of numbers."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key(str(name))}: {flow(item)}" for name, item in value.items()) + "}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True)
    if isinstance(value, Sequence):  # bytes too
        return "[" + ", ".join(flow(item) for item in value) + "]"
    if isinstance(value, float):
        return _number(value)
    return json.dumps(value)


def _number(value: float) -> str:
    if math.isnan(value):
        return ".nan"
    if math.isinf(value):
        return ".inf" if value > 0 else "-.inf"
    return repr(value)
