"""The check of `overwritten-input`: a report that would overwrite an input of the job."""

from __future__ import annotations

from collections.abc import Iterator
from os.path import normpath

from mosaico_ingest.lint.check import Check, Job, Problem, recording_paths


def check(job: Job) -> Iterator[Problem]:
    """Report a report path that is also a recording, the metadata file or the manifest."""
    report = job.manifest.run.report
    if report is None:
        return
    inputs = [text for _, text in recording_paths(job)]
    inputs += [text for text in (job.manifest.sequence.metadata_file, job.source.file) if text is not None]
    if normpath(report) in {normpath(text) for text in inputs}:
        message = f"the report would overwrite {report}, which the job reads"
        yield Problem(message, job.span("run", "report"), "write the report elsewhere")


CHECK = Check("overwritten-input", job=check)
