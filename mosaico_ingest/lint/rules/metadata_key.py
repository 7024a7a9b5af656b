"""The rule `metadata-key`: a metadata key that is invalid or reserved."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.lint.job import Job, keys_below, metadata_places
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each key, of a sequence's or a topic's metadata, at any depth."""
    for place in metadata_places(job):
        for path in keys_below(job.source.at(place), place):
            key = path[-1]
            if isinstance(key, str) and (not _KEY.fullmatch(key) or "--" in key):
                remedy = "use letters, digits, blanks, _ and single -"
                yield Problem(
                    f"the metadata key {key!r} is refused by the platform", job.source.key_span(path), remedy
                )
    taken = ("sequence", "metadata", PROVENANCE_KEY)
    if PROVENANCE_KEY in job.manifest.sequence.metadata:
        what = f"the metadata key {PROVENANCE_KEY!r} is where a run notes what the sequence was made from"
        yield Problem(what, job.source.key_span(taken), "use another key")


_KEY = re.compile(r"[A-Za-z0-9 _-]+")


CHECK = Check("metadata-key", job=check)
