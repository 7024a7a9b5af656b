"""The check of `repeated-pattern`: a topic pattern that an earlier pattern already covers."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, covers


def check(job: Job) -> Iterator[Problem]:
    """Report each pattern that an earlier pattern covers, with no pattern of the opposite kind between them."""
    patterns = job.manifest.topics
    for i, pattern in enumerate(patterns):
        for j in range(i - 1, -1, -1):
            earlier = patterns[j]
            if earlier.startswith("!") != pattern.startswith("!"):
                break
            if covers(earlier.removeprefix("!"), pattern.removeprefix("!")):
                line = job.span("topics", j).line
                message = f"{earlier!r} in line {line} already covers {pattern!r}"
                yield Problem(message, job.span("topics", i), "remove it")
                break


CHECK = Check("repeated-pattern", job=check)
