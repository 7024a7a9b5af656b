"""The check of `missing-folder`: a report path in a folder that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import Check, Job, Problem


def check(job: Job) -> Iterator[Problem]:
    """Report a report path whose folder does not exist."""
    report = job.manifest.run.report
    if report is not None and job.is_expanded(report) and not job.resolve(report).parent.is_dir():
        message = f"the folder {job.resolve(report).parent} does not exist"
        yield Problem(message, job.span("run", "report"), "create it, or write the report elsewhere")


CHECK = Check("missing-folder", job=check, reads_files=True)
