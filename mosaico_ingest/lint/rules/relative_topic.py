"""The rule `relative-topic`: a topic name without a leading slash."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, topic_patterns
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each name or glob that starts with a letter."""
    for place, pattern, span in topic_patterns(job):
        bare = pattern.removeprefix("!")
        if bare[:1].isalpha():
            sign = pattern[: len(pattern) - len(bare)]
            yield Problem(f"{pattern!r} in {place} has no leading slash", span, f"write {sign}/{bare}")


CHECK = Check("relative-topic", job=check)
