"""The check of `machine-path`: a path that exists only on one machine."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem, manifest_paths


def check(job: Job) -> Iterator[Problem]:
    """Report each path that is absolute or in a home directory, unless a variable provides it."""
    for path, text in manifest_paths(job):
        unexpanded = job.source.at(path)
        if text.startswith(("/", "~")) and isinstance(unexpanded, str) and not unexpanded.startswith("$"):
            message = f"{text} exists only on this machine"
            yield Problem(message, job.source.span(path), "make it relative, or write ${DATA}/…")


CHECK = Check("machine-path", job=check)
