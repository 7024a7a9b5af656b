"""`overridden-pattern`: a pattern that a later one undoes.

Patterns apply in order and the last that matches decides. What this one takes in, or leaves out, is turned round again
below, so it has no effect.

Bad:
    bag: {path: data/run.mcap}
    topics: [/camera/front, /imu, "!/camera/*"]

Good:
    bag: {path: data/run.mcap}
    topics: [/camera/*, /imu, "!/camera/front"]
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, bare, covers
from mosaico_ingest.lint.rule import Problem, Rule


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


RULE = Rule("ING203", __name__, Severity.WARNING, __doc__, job=check)
