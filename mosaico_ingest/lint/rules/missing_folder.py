"""The rule `missing-folder`: a report path in a folder that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the report's folder does not exist."""
    report = job.manifest.run.report
    if report is not None and job.known(report) and not job.resolve(report).parent.is_dir():
        message = f"there is no folder {job.resolve(report).parent}"
        yield Problem(message, job.span("run", "report"), "make it, or write the report elsewhere")


CHECK = Check("missing-folder", job=check, reads_files=True)
