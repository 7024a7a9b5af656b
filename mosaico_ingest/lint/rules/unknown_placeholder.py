"""The check of `unknown-placeholder`: an unknown placeholder in the sequence name."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import nearest
from mosaico_ingest.job.manifest import PLACEHOLDERS, placeholders_in
from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report each unknown placeholder in the sequence name."""
    name = job.manifest.sequence.name
    for placeholder in placeholders_in(name):
        if placeholder.known or name[placeholder.start - 1 : placeholder.start] == "$":
            continue
        close = nearest(placeholder.name, PLACEHOLDERS)
        suggestion = f"did you mean {{{close}}}? " if close else ""
        allowed = ", ".join(f"{{{placeholder_name}}}" for placeholder_name in PLACEHOLDERS)
        span = job.source.inner_span(("sequence", "name"), placeholder.start, placeholder.end)
        message = f"unknown placeholder {name[placeholder.start : placeholder.end]}"
        yield Problem(message, span, f"{suggestion}allowed: {allowed}")


CHECK = Check("unknown-placeholder", job=check)
