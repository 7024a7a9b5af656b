"""The check of `topic-pattern`: a topic pattern that cannot match any topic name."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.validation import pattern_problems
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report each pattern of `topics` and `expect` that cannot match any topic name."""
    for problem in pattern_problems(job.manifest, job.source):
        if job.is_expanded(problem.pattern):
            yield Problem(problem.message, problem.span, problem.hint)


CHECK = Check("topic-pattern", job=check)
