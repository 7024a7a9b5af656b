"""The check of `metadata-key`: a metadata key that is invalid or reserved."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.lint.check import Check, Job, Problem, key_paths_below, metadata_sections

_KEY = re.compile(r"[A-Za-z0-9 _-]+")


def check(job: Job) -> Iterator[Problem]:
    """Report invalid metadata keys at any depth, and the reserved key of the provenance."""
    for section in metadata_sections(job):
        for path in key_paths_below(job.source.at(section), section):
            key = path[-1]
            if isinstance(key, str) and (not _KEY.fullmatch(key) or "--" in key):
                message = f"the platform rejects the metadata key {key!r}"
                hint = "use letters, digits, spaces, _ and single -"
                yield Problem(message, job.source.key_span(path), hint)
    if PROVENANCE_KEY in job.manifest.sequence.metadata:
        message = f"the metadata key {PROVENANCE_KEY!r} is reserved for the provenance of the sequence"
        span = job.source.key_span(("sequence", "metadata", PROVENANCE_KEY))
        yield Problem(message, span, "use another key")


CHECK = Check("metadata-key", job=check)
