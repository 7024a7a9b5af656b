"""The check of `sequence-name`: a sequence name that the platform rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.manifest import placeholders_in
from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.protocol import check_sequence_name

_INVALID = re.compile(r"[^A-Za-z0-9_-]")


def check(job: Job) -> Iterator[Problem]:
    """Report the first character that the platform rejects, outside of placeholders."""
    name = job.manifest.sequence.name
    if not job.is_expanded(name):
        return
    literal = name
    for placeholder in placeholders_in(name):
        start, end = placeholder.start, placeholder.end
        literal = literal[:start] + "x" * (end - start) + literal[end:]
    try:
        check_sequence_name(literal)
    except SinkError:
        match = _INVALID.search(literal)
        start = match.start() if match else 0
        span = job.source.inner_span(("sequence", "name"), start, start + 1)
        message = f"a sequence name cannot contain {literal[start]!r}"
        yield Problem(message, span, "use letters, digits, _ and -")


CHECK = Check("sequence-name", job=check)
