"""`unknown-adapter`: a name that no adapter has.

An adapter is called by the name of a built-in, a loaded or an installed one, by the path of its YAML file, or by `module:Class` or
`file.py:Class`.

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
from mosaico_ingest.bridge import installed_adapters
from mosaico_ingest.diagnostics import Severity
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.references import adapter_references, is_mapping_file, loaded_names, python_reference
from mosaico_ingest.lint.rule import Problem, Rule
from mosaico_ingest.manifest.problems import nearest

_UNMODELED = UnmodeledSpec().name


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each name that no adapter has."""
    loaded = loaded_names(job)
    if loaded is None:
        return  # one that is loaded cannot be read, which is said elsewhere; it may have the name
    known = {*BY_NAME, _UNMODELED, *loaded}
    for place, reference in adapter_references(job):
        is_name = python_reference(reference) is None and not is_mapping_file(reference)
        if is_name and job.known(reference) and reference not in known and not _installed(reference):
            close = nearest(reference, known)
            hint = (
                f"did you mean {close}?" if close else "name a built-in adapter, a YAML file, or module:Class"
            )
            yield Problem(f"no adapter is called {reference!r}", job.source.span(place), hint)


def _installed(name: str) -> bool:
    """Whether an installed package has an adapter of that name; of one that is broken nothing is known."""
    try:
        return any(spec.name == name for _, spec in installed_adapters())
    except AdapterError:
        return True


RULE = Rule("ING219", __name__, Severity.ERROR, __doc__, job=check)
