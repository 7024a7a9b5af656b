"""The rule `overridden-pattern`: a topic pattern that a later pattern cancels."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, bare, covers
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each pattern all of whose topics a later one of the other kind takes."""
    patterns = job.manifest.topics
    for i, pattern in enumerate(patterns):
        for j in range(i + 1, len(patterns)):
            later = patterns[j]
            if later.startswith("!") != pattern.startswith("!") and covers(bare(later), bare(pattern)):
                line = job.span("topics", j).line
                message = f"{pattern!r} has no effect: {later!r} in line {line} undoes it"
                yield Problem(message, job.span("topics", i), "remove it, or put it below")
                break


CHECK = Check("overridden-pattern", job=check)
