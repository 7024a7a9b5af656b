"""The check of `metadata-number`: a metadata number that JSON cannot represent."""

from __future__ import annotations

import math
from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, metadata_sections, value_paths_below


def check(job: Job) -> Iterator[Problem]:
    """Report infinity and NaN in metadata."""
    for section in metadata_sections(job):
        for path in value_paths_below(job.source.at(section), section):
            value = job.source.at(path)
            if isinstance(value, float) and not math.isfinite(value):
                message = f"{value} cannot be stored as JSON"
                yield Problem(message, job.source.span(path), "write null, or put the value in quotes")


CHECK = Check("metadata-number", job=check)
