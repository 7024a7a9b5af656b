"""`missing-folder`: a report for a folder that is not there.

The report is written when the run is over; a folder that is not there by then loses it.

Bad:
    bag: {path: data/run.mcap}
    run: {report: nowhere/report.json}

Good:
    bag: {path: data/run.mcap}
    run: {report: report.json}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the report's folder does not exist."""
    report = job.manifest.run.report
    if report is not None and job.known(report) and not job.resolve(report).parent.is_dir():
        message = f"there is no folder {job.resolve(report).parent}"
        yield Problem(message, job.span("run", "report"), "make it, or write the report elsewhere")


RULE = Rule("ING233", __name__, Severity.WARNING, __doc__, job=check, disk=True)
