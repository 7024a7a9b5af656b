"""The check of `topic-pattern`: a topic pattern that cannot match any topic name."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.job.yaml_source import KeyPath
from mosaico_ingest.lint.job import Job, expected_patterns
from mosaico_ingest.lint.rule import Check, Problem

_MISTAKES = (
    (
        re.compile(r"\.[*+]|\\|[$^()|]"),
        "it is a regular expression",
        "write a glob, in which * matches any text",
    ),
    (re.compile(r"\s"), "it contains a space", "remove the space"),
    (re.compile(r"//"), "it contains two slashes in a row", "remove one slash"),
    (re.compile(r"(?<=.)/$"), "it ends with a slash", "remove the slash, or write /*"),
    (
        re.compile(r"\[(?!(?:!|(?!!))(?:\][^\]]*|[^\]]+)\]).*"),
        "its [ is never closed",
        "close the bracket, as in [ab], or write ? for a single character",
    ),
)


def check(job: Job) -> Iterator[Problem]:
    """Report each pattern of `topics` and `expect` that cannot match any topic name."""
    for i, pattern in enumerate(job.manifest.topics):
        if pattern in {"", "!"}:
            yield Problem(f"{pattern!r} excludes nothing", job.span("topics", i), 'write "!/topic"')
        else:
            yield from _check_pattern(job, ("topics", i), pattern)
    for path, pattern in expected_patterns(job):
        yield from _check_pattern(job, path, pattern)


def _check_pattern(job: Job, path: KeyPath, pattern: str) -> Iterator[Problem]:
    for mistake, reason, hint in _MISTAKES:
        match = mistake.search(pattern)
        if match is not None and job.is_expanded(pattern):
            span = job.source.inner_span(path, match.start(), match.end())
            yield Problem(f"{pattern!r} matches no topic, because {reason}", span, hint)
            return


CHECK = Check("topic-pattern", job=check)
