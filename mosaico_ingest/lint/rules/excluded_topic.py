"""The check of `excluded-topic`: a setting for a topic that `topics` excludes."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.values import is_glob, select
from mosaico_ingest.lint.check import Check, Job, Problem, keyed_patterns


def check(job: Job) -> Iterator[Problem]:
    """Report each key that is a topic name and that `topics` does not select."""
    patterns = job.manifest.topics
    if not patterns or not all(job.is_expanded(pattern) for pattern in patterns):
        return
    for section, name, span in keyed_patterns(job):
        if not is_glob(name) and not select(patterns, [name]).selected:
            message = f"{section} configures {name!r}, which topics excludes"
            yield Problem(message, span, "remove it, or add the topic to topics")


CHECK = Check("excluded-topic", job=check)
