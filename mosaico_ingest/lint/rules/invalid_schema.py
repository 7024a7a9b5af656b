"""The check of `invalid-schema`: a metadata schema that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.fields import PathRole
from mosaico_ingest.lint.check import Check, Job, Problem, manifest_paths
from mosaico_ingest.metadata import load_schema


def check(job: Job) -> Iterator[Problem]:
    """Report the mistakes in the schemas of a manifest, with their locations in the schema files."""
    for path, text in manifest_paths(job, PathRole.SCHEMA):
        if not job.resolve(text).is_file():
            continue
        try:
            load_schema(job.resolve(text))
        except ManifestError as error:
            for finding in error.findings:
                yield Problem(finding.message, finding.span or job.source.span(path), finding.help)


CHECK = Check("invalid-schema", job=check, reads_files=True)
