"""The check of `lock-file`: a lock file that does not exist or cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.pipeline.compile import read_lock_file
from mosaico_ingest.pipeline.definition_changes import read_lock


def check(job: Job) -> Iterator[Problem]:
    """Report `definitions: locked` if the manifest has no valid lock file."""
    if job.manifest.definitions is None or job.file is None:
        return
    try:
        read_lock(read_lock_file(job.file))
    except ManifestError as error:
        message = error.what if error.findings else f"{error.where}: {error.what}"
        yield Problem(message, job.span("definitions"), error.hint)


CHECK = Check("lock-file", job=check, reads_files=True)
