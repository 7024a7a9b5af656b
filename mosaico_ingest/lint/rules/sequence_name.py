"""The rule `sequence-name`: a sequence name that the platform rejects."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.compose import placeholders_in
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.protocol import check_sequence_name


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the name, with any placeholder filled in, is refused."""
    name = job.manifest.sequence.name
    if not job.known(name):
        return
    plain = name
    for placeholder in reversed(list(placeholders_in(name))):
        plain = (
            plain[: placeholder.start]
            + "x" * (placeholder.end - placeholder.start)
            + plain[placeholder.end :]
        )
    try:
        check_sequence_name(plain)
    except SinkError:
        refused = re.search(r"[^A-Za-z0-9_-]", plain)
        start = refused.start() if refused else 0
        span = job.source.inner_span(("sequence", "name"), start, start + 1)
        yield Problem(
            f"{plain[start]!r} cannot be in the name of a sequence", span, "use letters, digits, _ and -"
        )


CHECK = Check("sequence-name", job=check)
