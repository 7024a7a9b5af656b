"""The rule `unknown-adapter`: an adapter name that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.bridge import installed_adapters, suggest_reference
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.job.validation import nearest
from mosaico_ingest.lint.job import (
    Job,
    adapter_references,
    is_mapping_file,
    loaded_names,
    python_reference,
)
from mosaico_ingest.lint.rule import Check, Problem

_UNMODELED = UnmodeledSpec().name


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each name that no adapter has."""
    loaded = loaded_names(job)  # None where one cannot be read, which is said elsewhere; it may have the name
    known = {*BY_NAME, _UNMODELED, *(loaded or ())}
    for place, reference in adapter_references(job):
        if python_reference(reference) or is_mapping_file(reference) or not job.known(reference):
            continue
        is_file = reference.endswith(".py")
        if is_file or not (loaded is None or reference in known or _installed(reference)):
            close = None if is_file else nearest(reference, known)
            hint = f"did you mean {close}?" if close else suggest_reference(reference)
            yield Problem(f"no adapter is called {reference!r}", job.source.span(place), hint)


def _installed(name: str) -> bool:
    """Whether an installed package has an adapter of that name; of one that is broken nothing is known."""
    try:
        return any(spec.name == name for _, spec in installed_adapters())
    except AdapterError:
        return True


CHECK = Check("unknown-adapter", job=check)
