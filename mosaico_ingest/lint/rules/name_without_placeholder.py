"""The rule `name-without-placeholder`: a fixed sequence name for a glob of recordings."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.job.compose import placeholders_in
from mosaico_ingest.lint.job import Job, is_glob
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.remote import without_options


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the path is a glob and the name the same for all."""
    path, name = job.manifest.bag.path, job.manifest.sequence.name
    varying = any(
        placeholder.name in {"stem", "name", "index", "parent"} for placeholder in placeholders_in(name)
    )
    if isinstance(path, str) and is_glob(without_options(path)) and job.known(name) and not varying:
        span = job.span("sequence", "name")
        message = f"every recording that {path} matches would be named {name!r}"
        yield Problem(message, span, "put {stem} or {index} into it")


CHECK = Check("name-without-placeholder", job=check)
