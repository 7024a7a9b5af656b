"""The checks of `msg-field-name` and `msg-constant-name`: a name that ROS 2 rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Declaration, MessageFile, Problem

_FIELD_NAME = re.compile(r"[a-z](_?[a-z0-9]+)*")
_CONSTANT_NAME = re.compile(r"[A-Z](_?[A-Z0-9]+)*")


def check_field_names(message: MessageFile) -> Iterator[Problem]:
    """Report each field whose name is not in lower case with single underscores."""
    for declaration in message.declarations:
        if not declaration.is_constant and not _FIELD_NAME.fullmatch(declaration.name):
            yield _problem(declaration, "field", "snake_case")


def check_constant_names(message: MessageFile) -> Iterator[Problem]:
    """Report each constant whose name is not in upper case with single underscores."""
    for declaration in message.declarations:
        if declaration.is_constant and not _CONSTANT_NAME.fullmatch(declaration.name):
            yield _problem(declaration, "constant", "UPPER_CASE")


def _problem(declaration: Declaration, kind: str, form: str) -> Problem:
    text = f"{declaration.name!r} is not a valid ROS 2 {kind} name"
    return Problem(text, declaration.name_span, f"write it in the form {form}")


CHECKS = (
    Check("msg-field-name", message=check_field_names),
    Check("msg-constant-name", message=check_constant_names),
)
