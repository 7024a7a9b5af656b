"""This file writes a document as YAML that reads back as the same values, with a comment on where they come from."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import TypeAlias

from mosaico_ingest.manifest.scalars import Scalar, resolve_plain
from mosaico_ingest.manifest.source import Path, Value

__all__ = ["Remark", "plain", "to_yaml"]

Remark: TypeAlias = Callable[[Path], "str | None"]
"""What to say beside the value at a path; None: nothing."""

_PLAIN = re.compile(r"[A-Za-z0-9_./~+-]([A-Za-z0-9_./~+:-]*[A-Za-z0-9_./~+-])?")
_UNPRINTABLE = re.compile(r"[\x7f-\x9f\u2028\u2029\ufeff\ud800-\udfff\ufffe\uffff]")
_WIDTH = 100


def plain(value: Scalar) -> str:
    """Return a scalar, quoted where it would not be read as the same value by everybody."""
    if not isinstance(value, str):
        return _number(value) if isinstance(value, float) else json.dumps(value)
    if _PLAIN.fullmatch(value) and resolve_plain(value) == (value, None) and value[0] not in "-~":
        return value
    quoted = json.dumps(value, ensure_ascii=False)
    return _UNPRINTABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def to_yaml(value: Value, remark: Remark = lambda _: None) -> str:
    """Return a document in block style; lists of single values that are short stay on a line."""
    if isinstance(value, dict | list) and value:
        return "".join(f"{line}\n" for line in _lines(value, (), remark))
    return f"{_flow(value)}\n"


def _lines(value: Value, path: Path, remark: Remark) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _entry(f"{plain(key)}:", inner, (*path, key), remark)
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            yield from _item(inner, (*path, position), remark)


def _entry(head: str, value: Value, path: Path, remark: Remark) -> Iterator[str]:
    if _is_short(value):
        said = remark(path)
        yield f"{head} {_flow(value)}" + (f"  # {said}" if said else "")
    else:
        yield head
        yield from (f"  {line}" for line in _lines(value, path, remark))


def _item(value: Value, path: Path, remark: Remark) -> Iterator[str]:
    if _is_short(value):
        yield from _entry("-", value, path, remark)
    else:
        lines = _lines(value, path, remark)
        yield f"- {next(lines)}"
        yield from (f"  {line}" for line in lines)


def _is_short(value: Value) -> bool:
    if isinstance(value, dict):
        return not value
    if isinstance(value, list):
        single = not any(isinstance(item, list | dict) for item in value)
        return single and len(_flow(value)) <= _WIDTH
    return True


def _flow(value: Value) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_flow(item) for item in value)}]"
    return "{}" if isinstance(value, dict) else plain(value)


def _number(value: float) -> str:
    if value != value:  # noqa: PLR0124 - not a number
        return ".nan"
    mantissa, exponent, power = repr(value).partition("e")
    if exponent and "." not in mantissa:
        mantissa += ".0"  # without it, it is a text to some readers
    return {float("inf"): ".inf", float("-inf"): "-.inf"}.get(value, f"{mantissa}{exponent}{power}")
