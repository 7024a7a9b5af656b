"""`repeated-split`: a part that is named twice.

Its messages would be in the sequence twice.

Bad:
    bag: {path: [data/part_0.mcap, ./data/part_0.mcap]}

Good:
    bag: {path: [data/part_0.mcap, data/part_1.mcap]}
"""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each part that is the same path as an earlier one."""
    seen: dict[str, int] = {}
    for place, path in recording_paths(job):
        normal = normpath(path)
        if normal in seen:
            message = f"{path} is already named in line {seen[normal]}"
            yield Problem(message, job.source.span(place), "remove one of the two")
        seen.setdefault(normal, job.source.span(place).line)


RULE = Rule("ING216", __name__, Severity.ERROR, __doc__, job=check)
