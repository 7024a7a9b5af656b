"""The rule `missing-file`: a file that the job needs and that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each file that does not exist."""
    needed = {
        ("sequence", "metadata_file"): job.manifest.sequence.metadata_file,
        ("target", "tls_cert"): job.manifest.target.tls_cert,
    }
    for place, path in needed.items():
        if path is not None and job.known(path) and not job.resolve(path).is_file():
            remedy = "paths start at the manifest's folder"
            yield Problem(f"there is no file {job.resolve(path)}", job.source.span(place), remedy)


CHECK = Check("missing-file", job=check, reads_files=True)
