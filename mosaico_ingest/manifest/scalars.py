"""This file says what a plain YAML scalar means: YAML 1.2's core schema, and where YAML 1.1 disagrees."""

from __future__ import annotations

import re

from mosaico_ingest.frozen import frozen

__all__ = ["Scalar", "Trap", "resolve_plain"]

Scalar = str | int | float | bool | None

_CONSTANTS: dict[str, Scalar] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), float("nan")),
    **dict.fromkeys((".inf", ".Inf", ".INF", "+.inf", "+.Inf", "+.INF"), float("inf")),
    **dict.fromkeys(("-.inf", "-.Inf", "-.INF"), float("-inf")),
}
_OLD_BOOLEANS = {"yes": "true", "on": "true", "no": "false", "off": "false"}
_INTEGER = re.compile(r"[-+]?[0-9]+")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WHOLE = re.compile(r"[-+]?(0x[0-9a-fA-F]+|0?o?[0-9]+)")
_LONGEST_NUMBER = 1000
_OCTAL = re.compile(r"[-+]?0o?[0-7]+")
_PADDED = re.compile(r"[-+]?0[0-9]+")
_OTHER_NUMBER = re.compile(
    r"[-+]?(0b[01_]+|0x[0-9a-fA-F]*_[0-9a-fA-F_]*|[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?|[0-9]+(:[0-5]?[0-9])+(\.[0-9]*)?)"
)


@frozen
class Trap:
    """A scalar that YAML readers understand differently."""

    rule: str
    message: str
    help: str


def resolve_plain(text: str) -> tuple[Scalar, Trap | None]:
    """Return the value of an unquoted scalar, and why it should not be written like this, if so."""
    if text in _CONSTANTS:
        return _CONSTANTS[text], None
    meant = _OLD_BOOLEANS.get(text.lower()) if text in {text.lower(), text.upper(), text.title()} else None
    if meant is not None:
        message = f"{text} is a boolean to some YAML readers and text to others"
        return text, Trap("yaml-boolean", message, f'write {meant}, or "{text}" for the text')
    if text[:1] not in "+-.0123456789":
        return text, None
    if len(text) > _LONGEST_NUMBER and _WHOLE.fullmatch(text):
        message = f"a number of {len(text)} characters"
        return text, Trap("yaml-number", message, f"quote it, or write at most {_LONGEST_NUMBER}")
    return _number(text)


def _number(text: str) -> tuple[Scalar, Trap | None]:
    trap = _trap(text)
    if trap is not None:
        return text, trap
    if _INTEGER.fullmatch(text):
        return int(text), None
    if _HEXADECIMAL.fullmatch(text):
        return int(text, 16), None
    return (float(text) if _FLOAT.fullmatch(text) else text), None


def _trap(text: str) -> Trap | None:
    if _OCTAL.fullmatch(text) and text.lstrip("+-") != "0":
        digits = str(int(text.replace("o", ""), 8))
        says = f"{text} is {digits} to some YAML readers (octal) and something else to others"
    elif _PADDED.fullmatch(text):
        digits = str(int(text))
        says = f"{text} is {digits} to some YAML readers and text to others"
    elif _OTHER_NUMBER.fullmatch(text):
        digits = "the digits alone"
        says = f"{text} is a number to some YAML readers and text to others"
    else:
        return None
    return Trap("yaml-number", says, f'write {digits}, or "{text}" for the text')
