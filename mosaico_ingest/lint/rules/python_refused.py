"""The check of `python-refused`: an adapter in Python in a job that refuses Python."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.adapters.python import is_python_allowed, python_refusal
from mosaico_ingest.lint.check import Check, Job, Problem, adapter_references, python_reference


def check(job: Job) -> Iterator[Problem]:
    """Report every adapter in Python, if the manifest or `--no-python` refuses them."""
    if job.manifest.adapters.python and is_python_allowed():
        return
    for path, reference in adapter_references(job):
        if python_reference(reference) is not None:
            message, hint = python_refusal(reference)
            yield Problem(message, job.source.span(path), hint)


CHECK = Check("python-refused", job=check)
