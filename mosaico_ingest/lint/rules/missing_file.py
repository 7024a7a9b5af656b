"""The check of `missing-file`: a file that the job needs and that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.fields import PathRole
from mosaico_ingest.lint.check import Check, Job, Problem, manifest_paths


def check(job: Job) -> Iterator[Problem]:
    """Report a metadata file, metadata schema or TLS certificate that does not exist."""
    for path, text in manifest_paths(job, PathRole.INPUT, PathRole.WORKER_FILE, PathRole.SCHEMA):
        if not job.resolve(text).is_file():
            message = f"the file {job.resolve(text)} does not exist"
            hint = "correct the path; it starts at the manifest's folder"
            yield Problem(message, job.source.span(path), hint)


CHECK = Check("missing-file", job=check, reads_files=True)
