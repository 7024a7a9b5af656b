"""The rule `excluded-topic`: a setting for a topic that `topics` excludes."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.patterns import select
from mosaico_ingest.lint.job import Job, is_glob, keyed_patterns
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each key that is a topic's name and that `topics` does not select."""
    patterns = job.manifest.topics
    if not patterns or not all(job.known(pattern) for pattern in patterns):
        return
    for section, name, span in keyed_patterns(job):
        if not is_glob(name) and not select(patterns, [name]).selected:
            yield Problem(
                f"{section} names {name!r}, which topics leaves out", span, "remove it, or add it to topics"
            )


CHECK = Check("excluded-topic", job=check)
