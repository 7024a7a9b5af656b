"""`metadata-key`: a metadata key the platform refuses, or one that is taken.

Keys are letters, digits, blanks, `_` and single `-`, at every depth: a dot or slash would clash with the paths of queries.
Under `mosaico_ingest` a run notes what the sequence was made from.

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {driver: {v2.1: true}}

Bad:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {mosaico_ingest: nightly}

Good:
    bag: {path: data/run.mcap}
    sequence:
      metadata: {driver: {version: v2.1}}
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.job.values import PROVENANCE_KEY
from mosaico_ingest.lint.job import Job, keys_below, metadata_places
from mosaico_ingest.lint.rule import Problem, Rule


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


RULE = Rule("ING209", __name__, Severity.ERROR, __doc__, job=check)
