"""The check of `wrong-url`: a URL that cannot be used."""

from __future__ import annotations

from collections.abc import Iterator

from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import has_credentials
from mosaico_ingest.job.fields import PathRole
from mosaico_ingest.lint.check import Check, Job, Problem, manifest_paths
from mosaico_ingest.remote import is_url, parse_url

_URL_ROLES = [role for role in PathRole if role.accepts_urls]


def check(job: Job) -> Iterator[Problem]:
    """Report URLs that are invalid, or in a place that requires a local path. No connection is opened."""
    url_keys = {path for path, _ in manifest_paths(job, *_URL_ROLES)}
    for path, text in manifest_paths(job):
        if not is_url(text) or has_credentials(text):
            continue  # `plaintext-secret` reports credentials.
        span = job.source.span(path)
        if path not in url_keys:
            message = f"{'.'.join(map(str, path))} is a URL, but only recordings and stores can be URLs"
            yield Problem(message, span, "name a local file")
        else:
            try:
                parse_url(text)
            except IngestError as error:
                yield Problem(f"{error.where}: {error.what}", span, error.hint or "")


CHECK = Check("wrong-url", job=check)
