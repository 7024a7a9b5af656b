"""The rule `changed-number`: a metadata number that loses digits."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from decimal import Decimal

from mosaico_ingest.findings import Edit
from mosaico_ingest.lint.job import Job, metadata_places, values_below
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each number in metadata that loses digits."""
    for place in metadata_places(job):
        for path in values_below(job.source.at(place), place):
            value, span = job.source.at(path), job.source.span(path)
            written = job.source.line(span)[span.column - 1 : span.end_column - 1]
            if isinstance(value, float) and math.isfinite(value) and _loses(written, value):
                remedy = f'for a text write "{written}"'
                yield Problem(
                    f"{written} is kept as the number {value}", span, remedy, Edit(span, f'"{written}"')
                )


def _loses(written: str, value: float) -> bool:
    zeros = re.fullmatch(r"[0-9]+\.[0-9]+0", written) is not None
    return zeros or (
        re.fullmatch(r"[0-9.]+", written) is not None and Decimal(written) != Decimal(repr(value))
    )


CHECK = Check("changed-number", job=check)
