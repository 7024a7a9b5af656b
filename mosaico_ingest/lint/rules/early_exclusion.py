"""The rule `early-exclusion`: an exclusion above the first topic pattern that includes anything."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, bare, covers
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each exclusion that comes before the first inclusion, unless that undoes it."""
    patterns = job.manifest.topics
    first = next((i for i, pattern in enumerate(patterns) if not pattern.startswith("!")), None)
    for i in range(first or 0):
        if not any(covers(later, bare(patterns[i])) for later in patterns[i + 1 :] if later[:1] != "!"):
            message = f"{patterns[i]!r} has nothing to leave out: no pattern above it includes anything"
            yield Problem(message, job.span("topics", i), "put it below what it is an exception of")


CHECK = Check("early-exclusion", job=check)
