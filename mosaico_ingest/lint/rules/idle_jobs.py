"""`idle-jobs`: parallel jobs for a single recording.

`run.jobs` is how many recordings are ingested at the same time; here there is one.

Bad:
    bag: {path: data/run.mcap}
    run: {jobs: 4}

Good:
    bag: {path: "data/*.mcap"}
    sequence: {name: "{stem}"}
    run: {jobs: 4}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job, is_glob
from mosaico_ingest.lint.rule import Problem, Rule
from mosaico_ingest.remote import without_options


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if there are more jobs than one and the path is no glob."""
    path = job.manifest.bag.path
    if job.manifest.run.jobs > 1 and not (
        isinstance(path, str) and (is_glob(without_options(path)) or not job.known(path))
    ):
        yield Problem("there is one recording, so one job", job.span("run", "jobs"), "remove it")


RULE = Rule("ING237", __name__, Severity.INFO, __doc__, job=check)
