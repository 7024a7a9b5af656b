"""`missing-adapter`: an adapter whose file or module is not there.

Paths start at the manifest's folder. A module is looked for where Python looks, and then in that folder; nothing of it
is run.

Bad:
    bag: {path: data/run.mcap}
    adapters:
      load: [nowhere/pack.yaml]

Good:
    bag: {path: data/run.mcap}
    adapters:
      load: [adapters/pack.yaml]
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import (
    Job,
    adapter_references,
    find_module,
    is_mapping_file,
    python_reference,
)
from mosaico_ingest.lint.rule import Problem, Rule


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


RULE = Rule("ING238", __name__, Severity.ERROR, __doc__, job=check, disk=True)
