"""The check of `name-without-placeholder`: a fixed sequence name for a glob of recordings."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.manifest import placeholders_in
from mosaico_ingest.job.values import is_glob
from mosaico_ingest.lint.check import Check, Job, Problem
from mosaico_ingest.remote import without_options

_VARYING = frozenset({"stem", "name", "index", "parent"})
"""Placeholders whose value differs between recordings."""


def check(job: Job) -> Iterator[Problem]:
    """Report a fixed sequence name if the path is a glob."""
    path, name = job.manifest.bag.path, job.manifest.sequence.name
    if not isinstance(path, str) or not is_glob(without_options(path)) or not job.is_expanded(name):
        return
    if not any(placeholder.name in _VARYING for placeholder in placeholders_in(name)):
        message = f"every recording that {without_options(path)} matches would be named {name!r}"
        yield Problem(message, job.span("sequence", "name"), "add {stem} or {index} to the name")


CHECK = Check("name-without-placeholder", job=check)
