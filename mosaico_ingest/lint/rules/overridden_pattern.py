"""The check of `overridden-pattern`: a topic pattern that a later pattern cancels."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, covers


def check(job: Job) -> Iterator[Problem]:
    """Report each pattern whose topics a later pattern of the opposite kind matches."""
    patterns = job.manifest.topics
    for i, pattern in enumerate(patterns):
        for j, later in enumerate(patterns[i + 1 :], i + 1):
            is_opposite = later.startswith("!") != pattern.startswith("!")
            if is_opposite and covers(later.removeprefix("!"), pattern.removeprefix("!")):
                line = job.span("topics", j).line
                message = f"{pattern!r} has no effect, because {later!r} in line {line} overrides it"
                yield Problem(message, job.span("topics", i), "remove it, or put it below that pattern")
                break


CHECK = Check("overridden-pattern", job=check)
