"""The check of `early-exclusion`: an exclusion above the first topic pattern that includes anything."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, covers


def check(job: Job) -> Iterator[Problem]:
    """Report each exclusion above the first inclusion, unless `overridden-pattern` reports it."""
    patterns = job.manifest.topics
    first = next((i for i, pattern in enumerate(patterns) if not pattern.startswith("!")), 0)
    for i, pattern in enumerate(patterns[:first]):
        inclusions = (later for later in patterns[first:] if not later.startswith("!"))
        if not any(covers(later, pattern.removeprefix("!")) for later in inclusions):
            message = f"{pattern!r} excludes nothing, because no pattern above it includes anything"
            yield Problem(message, job.span("topics", i), "put it below the pattern that it restricts")


CHECK = Check("early-exclusion", job=check)
