"""The rule `topic-pattern`: a topic pattern that cannot match any topic name."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem

_FAULTS = (
    (
        re.compile(r"\.[*+]|\\|[$^()|]"),
        "it is a regular expression",
        "patterns are globs: * matches anything",
    ),
    (re.compile(r"\s"), "there is a blank in it", "remove it"),
    (re.compile(r"//"), "there are two slashes in a row", "remove one"),
    (re.compile(r"(?<=.)/$"), "it ends with a slash", "remove it, or write /*"),
)


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each pattern of `topics` that is no glob of a topic name."""
    for i, pattern in enumerate(job.manifest.topics):
        glob = pattern.removeprefix("!")
        if not glob:
            yield Problem("'!' alone leaves out nothing", job.span("topics", i), 'write "!/topic"')
            continue
        for fault, reason, remedy in _FAULTS:
            match = fault.search(pattern)
            if match is not None and job.known(pattern):
                span = job.source.inner_span(("topics", i), match.start(), match.end())
                yield Problem(f"{pattern!r} matches no topic: {reason}", span, remedy)
                break


CHECK = Check("topic-pattern", job=check)
