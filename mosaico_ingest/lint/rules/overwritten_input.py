"""The rule `overwritten-input`: a report that would overwrite an input of the job."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath

from mosaico_ingest.lint.job import Job, recording_paths
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the report is also a recording, the metadata or the manifest."""
    report = job.manifest.run.report
    if report is None:
        return
    inputs = [path for _, path in recording_paths(job)]
    inputs += [path for path in (job.manifest.sequence.metadata_file, job.source.file) if path is not None]
    if normpath(report) in {normpath(path) for path in inputs}:
        yield Problem(
            f"{report} is read by this job", job.span("run", "report"), "write the report elsewhere"
        )


CHECK = Check("overwritten-input", job=check)
