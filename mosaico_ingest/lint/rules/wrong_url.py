"""The rule `wrong-url`: a URL that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import IngestError
from mosaico_ingest.lint.job import Job, all_paths
from mosaico_ingest.lint.rule import Check, Problem
from mosaico_ingest.remote import as_path, is_url

_MAY_BE_URLS = {("bag", "path"), ("target", "store")}


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem for each URL that is not understood, or that stands where a file must be; nobody is asked."""
    for place, path in all_paths(job):
        if not is_url(path):
            continue
        if place[:2] not in _MAY_BE_URLS:
            message = f"{'.'.join(map(str, place))} is a URL, and only recordings and stores may be"
            yield Problem(message, job.source.span(place), "name a file")
            continue
        try:
            as_path(path)
        except IngestError as error:
            yield Problem(f"{error.where}: {error.what}", job.source.span(place), error.hint or "")


CHECK = Check("wrong-url", job=check)
