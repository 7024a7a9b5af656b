"""`unknown-adapter`: an adapter that cannot be found.

It is called by the name of a built-in adapter, by the path of a YAML file, or by `module:Class` or `file.py:Class`.
There is none of this name, no such file or no such module.

Bad:
    bag: {path: data/run.mcap}
    adapters:
      override: {/lidar: LidarAdaptor}

Good:
    bag: {path: data/run.mcap}
    adapters:
      override: {/lidar: LidarAdapter}
"""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.unmodeled import UnmodeledSpec
from mosaico_ingest.diagnostics import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.references import adapter_references, find_module, loaded_names, python_reference
from mosaico_ingest.lint.rule import Problem, Rule
from mosaico_ingest.manifest.problems import nearest


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each adapter that is nowhere."""
    known = {*BY_NAME, UNMODELED, *loaded_names(job)}
    for place, reference in adapter_references(job):
        if job.known(reference) and reference not in known:
            missing = _missing(job, reference)
            if missing is not None:
                yield Problem(missing[0], job.source.span(place), missing[1])


def _missing(job: Job, reference: str) -> tuple[str, str] | None:
    """Return what is not there and what to do about it."""
    starts = "paths start at the manifest's folder"
    python = python_reference(reference)
    if reference.endswith((".yaml", ".yml")):
        return (
            None
            if job.resolve(reference).is_file()
            else (f"there is no file {job.resolve(reference)}", starts)
        )
    if python is None:
        close = nearest(reference, BY_NAME)
        hint = f"did you mean {close}?" if close else "name a built-in adapter, a YAML file, or module:Class"
        return f"no adapter is called {reference!r}", hint
    if python.is_file:
        there = job.resolve(python.module).is_file()
        return None if there else (f"there is no file {job.resolve(python.module)}", starts)
    if find_module(python.module, job.folder) is None:
        return f"there is no module {python.module}", f"install it, or put it into {job.folder}"
    return None


UNMODELED = UnmodeledSpec().name


RULE = Rule("ING219", __name__, Severity.ERROR, __doc__, job=check)
