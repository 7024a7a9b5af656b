"""The rule `repeated-pattern`: a topic pattern that an earlier pattern already covers."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job, bare, covers
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each pattern that repeats an earlier one."""
    patterns = job.manifest.topics
    for i, pattern in enumerate(patterns):
        for j in range(i - 1, -1, -1):
            earlier = patterns[j]
            if earlier.startswith("!") != pattern.startswith("!"):
                break  # the order matters here
            if covers(bare(earlier), bare(pattern)):
                line = job.span("topics", j).line
                message = f"{pattern!r} adds nothing to {earlier!r} in line {line}"
                yield Problem(message, job.span("topics", i), "remove it")
                break


CHECK = Check("repeated-pattern", job=check)
