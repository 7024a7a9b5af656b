"""The rule `missing-adapter`: an adapter file or module that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.job import (
    Job,
    adapter_references,
    find_module,
    is_mapping_file,
    python_reference,
)
from mosaico_ingest.lint.rule import Check, Problem


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each adapter file or module that is nowhere."""
    for place, reference in adapter_references(job):
        missing = _missing(job, reference) if job.known(reference) else None
        if missing is not None:
            yield Problem(missing[0], job.source.span(place), missing[1])


def _missing(job: Job, reference: str) -> tuple[str, str] | None:
    """Return what is not there and what to do about it."""
    python = python_reference(reference)
    if python is not None and not python.is_file:
        if find_module(python.module, job.folder) is not None:
            return None
        return f"there is no module {python.module}", f"install it, or put it into {job.folder}"
    file = job.resolve(reference if python is None else python.module)
    if (python is None and not is_mapping_file(reference)) or file.is_file():
        return None
    return f"there is no file {file}", "paths start at the manifest's folder"


CHECK = Check("missing-adapter", job=check, reads_files=True)
