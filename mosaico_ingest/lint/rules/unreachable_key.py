"""The check of `unreachable-key`: a glob that an earlier glob hides."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.patterns import is_glob
from mosaico_ingest.lint.job import Job, covers, keyed_patterns
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report each glob that an earlier glob of the same section covers."""
    globs: list[tuple[str, str, int]] = []
    for section, pattern, span in keyed_patterns(job):
        if not is_glob(pattern):
            continue
        for earlier_section, earlier, line in globs:
            if earlier_section == section and covers(earlier, pattern):
                message = f"{pattern!r} is never used, because {earlier!r} in line {line} covers it"
                yield Problem(message, span, "put it above that glob")
                break
        globs.append((section, pattern, span.line))


CHECK = Check("unreachable-key", job=check)
