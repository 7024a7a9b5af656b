"""This file turns errors of a file system behind a URL into our own."""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager

from mosaico_ingest.errors import IngestError, Unreachable

__all__ = ["explained", "is_transient", "reaching"]

_REFUSED = re.compile(
    r"ACCESS_DENIED|INVALID_ACCESS_KEY|INVALID_SIGNATURE|INVALID_CLIENT_TOKEN|SIGNATURE_DOES_NOT_MATCH"
    r"|MISSING_AUTHENTICATION|EXPIRED_TOKEN|HTTP status 40[13]|PERMISSION_DENIED|UNAUTHENTICATED|PermissionDenied"
)
_TRANSIENT = re.compile(
    r"NETWORK_CONNECTION|SLOW_DOWN|THROTTLING|SERVICE_UNAVAILABLE|INTERNAL_FAILURE|REQUEST_TIMEOUT|REQUEST_EXPIRED"
    r"|HTTP status 5\d\d|curlCode|\bUNAVAILABLE\b|DEADLINE_EXCEEDED|Retry policy exhausted|[Tt]imed out"
)
_NO_BUCKET = re.compile(r"NO_SUCH_BUCKET|[Bb]ucket .*(does not exist|not found)")
_SDK = re.compile(r"^.*?AWS Error |\s*\(Request ID: [^)]*\)")


@contextmanager
def reaching(where: str) -> Generator[None, None, None]:
    """Raise our own error for what goes wrong on the way to `where`; a missing object stays a FileNotFoundError.

    Raises:
        Unreachable: Nobody answers, or not in time; the client has tried several times.
        IngestError: Access is refused, or something else is wrong with the request.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as err:
        raise explained(err, where) from err


def explained(err: OSError, where: str) -> IngestError:
    """Return the error of ours for one of a file system, about `where`."""
    said = _SDK.sub("", str(err).strip().splitlines()[0] if str(err).strip() else type(err).__name__)
    if is_transient(err):
        return Unreachable(f"does not answer: {said}", where=where, hint="check the address and the network")
    if _REFUSED.search(str(err)):
        hint = "check the credentials: the environment, the client's configuration, or the machine's role"
        return IngestError(f"access is refused: {said}", where=where, hint=hint)
    if _NO_BUCKET.search(str(err)):
        return IngestError(
            "there is no such bucket", where=where, hint="check the URL; buckets are not made here"
        )
    return IngestError(said, where=where)


def is_transient(err: OSError) -> bool:
    """Say whether trying again later may help."""
    return isinstance(err, ConnectionError | TimeoutError) or _TRANSIENT.search(str(err)) is not None
