"""The check of `changed-number`: a metadata number that loses digits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from decimal import Decimal

from mosaico_ingest.findings import Edit
from mosaico_ingest.lint.check import Check, Job, Problem, metadata_sections, value_paths_below

_TRAILING_ZERO = re.compile(r"[0-9]+\.[0-9]+0")
_DECIMAL = re.compile(r"[0-9.]+")


def check(job: Job) -> Iterator[Problem]:
    """Report each metadata number whose digits change when it is parsed."""
    for section in metadata_sections(job):
        for path in value_paths_below(job.source.at(section), section):
            value, span = job.source.at(path), job.source.span(path)
            text = job.source.line(span)[span.column - 1 : span.end_column - 1]
            if isinstance(value, float) and math.isfinite(value) and _loses_digits(text, value):
                message = f"{text} is stored as the number {value}"
                yield Problem(message, span, f'to store text, write "{text}"', Edit(span, f'"{text}"'))


def _loses_digits(text: str, value: float) -> bool:
    if _TRAILING_ZERO.fullmatch(text):
        return True
    return _DECIMAL.fullmatch(text) is not None and Decimal(text) != Decimal(repr(value))


CHECK = Check("changed-number", job=check)
