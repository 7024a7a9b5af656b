"""The check of `unknown-adapter`: an adapter name that does not exist."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.bridge import installed_adapters, suggest_reference
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.lint.check import (
    Check,
    Job,
    Problem,
    adapter_references,
    is_mapping_file,
    loaded_names,
    python_reference,
)


def check(job: Job) -> Iterator[Problem]:
    """Report each adapter name that no built-in, loaded or installed adapter has."""
    loaded = loaded_names(job)
    names = {*BY_NAME, UnmodeledSpec().name, *(loaded or ())}
    for path, reference in adapter_references(job):
        if python_reference(reference) or is_mapping_file(reference) or not job.is_expanded(reference):
            continue
        # If a loaded adapter cannot be read, another rule reports it, and it may have the name.
        exists = loaded is None or reference in names or _is_installed(reference)
        if reference.endswith(".py") or not exists:
            message = f"there is no adapter {reference!r}"
            yield Problem(message, job.source.span(path), suggest_reference(reference, names))


def _is_installed(name: str) -> bool:
    """Return whether an installed package provides the adapter, or cannot be imported to find out."""
    try:
        return any(spec.name == name for _, spec in installed_adapters())
    except AdapterError:
        return True


CHECK = Check("unknown-adapter", job=check)
