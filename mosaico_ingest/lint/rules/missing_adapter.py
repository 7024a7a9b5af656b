"""The check of `missing-adapter`: an adapter file or module that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.lint.check import (
    Check,
    Job,
    Problem,
    adapter_references,
    find_module,
    is_mapping_file,
    python_reference,
)


def check(job: Job) -> Iterator[Problem]:
    """Report adapter files and modules that do not exist."""
    for path, reference in adapter_references(job):
        problem = _problem(job, reference) if job.is_expanded(reference) else None
        if problem is not None:
            yield Problem(problem[0], job.source.span(path), problem[1])


def _problem(job: Job, reference: str) -> tuple[str, str] | None:
    """Return the message and the hint for a reference whose file or module does not exist."""
    python = python_reference(reference)
    if python is not None and not python.is_file:
        if find_module(python.module, job.folder) is not None:
            return None
        return f"the module {python.module} does not exist", f"install it, or put it into {job.folder}"
    file = job.resolve(reference if python is None else python.module)
    if file.is_file() or (python is None and not is_mapping_file(reference)):
        return None
    return f"the file {file} does not exist", "correct the path; it starts at the manifest's folder"


CHECK = Check("missing-adapter", job=check, reads_files=True)
