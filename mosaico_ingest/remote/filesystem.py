"""This file makes the file system that a URL speaks of; credentials come from where its clients look for them."""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import timedelta
from functools import lru_cache
from typing import TYPE_CHECKING
from urllib.parse import parse_qs

from mosaico_ingest.errors import IngestError

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

__all__ = ["SCHEMES", "filesystem"]

_ATTEMPTS = 5
"""How often a request is made, with a pause that doubles, before its failure is believed."""
_CONNECT_S, _REQUEST_S = 5.0, 30.0
_RETRY_S = 30.0


def filesystem(root: str, options: str) -> FileSystem:
    """Return the file system of `s3://bucket`, one for each process and set of options.

    Raises:
        IngestError: The scheme or an option is not known.
        Unreachable: The bucket's region could not be asked for.
    """
    return _made(root, options, os.getpid())  # a connection must not cross a fork


@lru_cache(maxsize=64)
def _made(root: str, options: str, _process: int) -> FileSystem:
    scheme, _, bucket = root.partition("://")
    make, known = SCHEMES[scheme]
    given = {name: values[-1] for name, values in parse_qs(options, keep_blank_values=True).items()}
    for name in given:
        if name not in known:
            raise IngestError(
                f"the option {name!r} is not known",
                where=f"{root}?{options}",
                hint=f"known are {', '.join(known)}",
            )
    return make(bucket, given)


def _s3(bucket: str, given: dict[str, str]) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    region = given.get("region")
    if region is None and "endpoint_override" not in given:
        from mosaico_ingest.remote.faults import reaching  # noqa: PLC0415 - the same

        with reaching(f"s3://{bucket}"):
            region = fs.resolve_s3_region(bucket)
    return fs.S3FileSystem(
        region=region,
        scheme=given.get("scheme", "https"),
        endpoint_override=given.get("endpoint_override"),
        anonymous=given.get("anonymous") == "true",
        connect_timeout=_CONNECT_S,
        request_timeout=_REQUEST_S,
        retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=_ATTEMPTS),
        allow_delayed_open=True,  # pyright: ignore[reportCallIssue] - the stubs are older; small objects are sent with one request
    )


def _gs(_bucket: str, given: dict[str, str]) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    return fs.GcsFileSystem(
        anonymous=given.get("anonymous") == "true",
        scheme=given.get("scheme", "https"),
        endpoint_override=given.get("endpoint_override"),
        retry_time_limit=timedelta(seconds=_RETRY_S),
    )


_Make = Callable[[str, dict[str, str]], "FileSystem"]
SCHEMES: dict[str, tuple[_Make, tuple[str, ...]]] = {
    "s3": (_s3, ("endpoint_override", "scheme", "region", "anonymous")),
    "gs": (_gs, ("endpoint_override", "scheme", "anonymous")),
}
"""What is understood, with the options each may have behind `?`."""
