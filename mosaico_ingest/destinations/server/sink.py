"""A Mosaico server as a destination, and the preflight check of its API key."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

from msgspec import Struct

from mosaico_ingest import protocol
from mosaico_ingest.destinations.base import Session
from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.destinations.server.errors import Refused, add_hint
from mosaico_ingest.destinations.server.session import PlatformSession
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.values import IfExists, ServerTarget
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition

__all__ = [
    "PlatformSink",
    "delete_finding",
]

_NO_SESSION = "0" * 26
"""As an identifier of a session is written; none has it."""


def delete_finding(target: ServerTarget, sequence: str) -> Finding | None:
    """Return a warning where the key may not delete; found by asking to delete what is not there.

    Raises:
        SinkError: There is no server, or it does not let us in.
    """
    question = messages.Located(locator=messages.session_locator(sequence, _NO_SESSION))
    try:
        with connect(target) as client:
            client.act(messages.SESSION_DELETE, question)
    except Refused as refusal:
        if refusal.condition is Condition.PERMISSION:
            return Finding(
                "delete-permission",
                Severity.WARNING,
                "on_error.session is delete, and the key may not delete: an early end leaves an unfinished "
                f"session, and the name {sequence!r} taken",
                help="use a key with the permission delete, or on_error.session: report",
            )
        if refusal.condition is Condition.UNAUTHENTICATED:
            raise
    return None


_BUFFER_BYTES = 96 << 20


class PlatformSink(Struct, frozen=True):
    """Writes sequences to a server; one session holds at most about `buffer_bytes` in memory.

    A server has no way to swap sequences, so `replace` deletes the old one when the session is opened; and it
    adds no rows to a topic that is there, so `append` takes new topics only.
    """

    target: ServerTarget
    buffer_bytes: int = _BUFFER_BYTES

    @contextmanager
    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        protocol.check_sequence_name(sequence)
        described = protocol.check_metadata(metadata, where=sequence)
        with connect(self.target) as client:
            session = PlatformSession(
                self.target, client, sequence, described, if_exists=if_exists, buffer_bytes=self.buffer_bytes
            )
            try:
                yield session
                session.commit()
            except BaseException as error:
                left = session.discard()
                if left and isinstance(error, IngestError):
                    add_hint(error, left)
                raise
