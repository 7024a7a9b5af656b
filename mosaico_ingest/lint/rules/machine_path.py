"""`machine-path`: a path that only this machine has.

An absolute path, or one that starts at somebody's home, makes the manifest work for one person.

Bad:
    bag: {path: /home/ada/run.mcap}

Good:
    bag: {path: "${DATA:-data}/run.mcap"}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, all_paths
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each path that is absolute as it is written."""
    for place, path in all_paths(job):
        written = job.source.at(place)
        if path.startswith(("/", "~")) and isinstance(written, str) and not written.startswith("$"):
            yield Problem(
                f"{path} is a path of one machine", job.source.span(place), "make it relative, or ${DATA}/…"
            )


RULE = Rule("ING236", __name__, Severity.WARNING, __doc__, job=check)
