"""The rule `metadata-number`: a metadata number that JSON cannot represent."""

from __future__ import annotations

import math
from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, metadata_places, values_below
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each infinite number or NaN in metadata."""
    for place in metadata_places(job):
        for path in values_below(job.source.at(place), place):
            value = job.source.at(path)
            if isinstance(value, float) and not math.isfinite(value):
                yield Problem(
                    f"{value} cannot be kept as JSON", job.source.span(path), "write null, or a text"
                )


CHECK = Check("metadata-number", job=check)
