"""The check of `repeated-split`: a split that is listed twice."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath

from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths


def check(job: Job) -> Iterator[Problem]:
    """Report each split whose path equals the path of an earlier split."""
    lines: dict[str, int] = {}
    for path, text in recording_paths(job):
        span = job.source.span(path)
        normal = normpath(text)
        if normal in lines:
            message = f"{text} is already listed in line {lines[normal]}"
            yield Problem(message, span, "remove one of the two")
        lines.setdefault(normal, span.line)


CHECK = Check("repeated-split", job=check)
