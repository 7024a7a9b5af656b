"""`missing-file`: a file the job needs and that is not there.

The metadata file and the certificate are read when the job starts.

Bad:
    bag: {path: data/run.mcap}
    sequence: {metadata_file: nowhere.json}

Good:
    bag: {path: data/run.mcap}
    sequence: {metadata_file: metadata.json}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


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


RULE = Rule("ING232", __name__, Severity.ERROR, __doc__, job=check, disk=True)
