"""A Mosaico server as a destination, its sink, and the preflight check of its API key."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from msgspec import Struct

from mosaico_ingest import protocol
from mosaico_ingest.destinations import (
    Destination,
    DestinationStatus,
    ExistingSequence,
    ExistingSession,
    Session,
    Sink,
)
from mosaico_ingest.destinations.server.client import Refused, ServerClient, add_hint
from mosaico_ingest.destinations.server.client import connect as connect_to
from mosaico_ingest.destinations.server.session import ServerSession
from mosaico_ingest.errors import IngestError, Interrupted, SinkError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.values import IfExists, ServerTarget, SessionLevelErrorPolicy
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition

_BUFFER_BYTES = 96 << 20
_OLD_VERSIONS = ("0.1.", "0.2.", "0.3.", "0.4.", "0.5.")
_NO_SESSION = "0" * 26
"""The id of no session, in the format of session ids."""


class ServerDestination(Destination):
    """A Mosaico server; every method but `describe` and `open_sink` connects to it."""

    kind: ClassVar[str] = "server"
    can_amend: ClassVar[bool] = True
    replaces_atomically: ClassVar[bool] = False

    def __init__(self, target: ServerTarget) -> None:
        self.target = target

    def describe(self, *, folder: Path | None = None) -> str:  # noqa: ARG002 - a server has no path
        """Return `host:port`."""
        return f"{self.target.host}:{self.target.port}"

    def inspect(self, sequence: str, *, connect: bool) -> DestinationStatus:
        """Return the current state, which is unknown without `connect`."""
        if not connect:
            return DestinationStatus()
        try:
            return DestinationStatus(exists=True, sequence=self.find(sequence))
        except SinkError as error:
            return DestinationStatus(exists=False, problem=str(error))

    def find(self, sequence: str) -> ExistingSequence | None:
        """Return the stored sequence of this name, or None; it has the metadata of its first session only."""
        with connect_to(self.target) as client:
            info = client.find(sequence)
            if info is None:
                return None
            question = messages.Located(locator=sequence)
            notifications = client.act(messages.SEQUENCE_NOTIFICATION_LIST, question).notifications
        is_finished = bool(info.sessions) and all(session.locked for session in info.sessions)
        return ExistingSequence(
            name=sequence,
            complete=is_finished and not notifications,
            sessions=(ExistingSession("", info.user_metadata),),
            has_all_sessions=False,
            finished=is_finished,
        )

    def open_sink(self, *, buffer_bytes: int) -> Sink:
        """Return a sink; its sessions connect."""
        return ServerSink(self.target, buffer_bytes)

    def preflight(self, sequence: str, on_error: SessionLevelErrorPolicy) -> tuple[Finding, ...]:
        """Return warnings about an old server, and about a key that has no permission for `on_error: delete`."""
        with connect_to(self.target) as client:
            findings = [_version_finding(client.version)]
            if on_error is SessionLevelErrorPolicy.Delete:
                findings.append(_delete_finding(client, sequence))
        return tuple(finding for finding in findings if finding is not None)


class ServerSink(Struct, frozen=True):
    """Writes sequences to a server; one session buffers at most about `buffer_bytes`.

    A server cannot swap sequences: `replace` keeps the new rows in temporary files and deletes the stored sequence at the
    commit. A server cannot append rows to an existing topic either: `append` accepts new topics only.
    """

    target: ServerTarget
    buffer_bytes: int = _BUFFER_BYTES

    @contextmanager
    def open(
        self,
        sequence: str,
        metadata: Mapping[str, Any],
        *,
        if_exists: IfExists = IfExists.FAIL,
        amendable: bool = False,
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`. An amendable one keeps its rows in temporary files until the commit."""
        protocol.check_sequence_name(sequence)
        described = protocol.check_metadata(metadata, where=sequence)
        with connect_to(self.target) as client:
            session = ServerSession(
                self.target,
                client,
                sequence,
                described,
                if_exists=if_exists,
                buffer_bytes=self.buffer_bytes,
                amendable=amendable,
            )
            try:
                yield session
                session.commit()
            except BaseException as error:
                hint = session.discard()
                if hint and isinstance(error, KeyboardInterrupt):
                    raise Interrupted("stopped during the upload", where=sequence, hint=hint) from error
                if hint and isinstance(error, IngestError):
                    add_hint(error, hint)
                raise


def _delete_finding(client: ServerClient, sequence: str) -> Finding | None:
    """Return a warning if the API key has no permission to delete, found by deleting a session that does not exist.

    Raises:
        SinkError: The server cannot be reached, or does not accept the API key.
    """
    question = messages.Located(locator=messages.session_locator(sequence, _NO_SESSION))
    try:
        client.act(messages.SESSION_DELETE, question)
    except Refused as refusal:
        if refusal.condition is Condition.PERMISSION:
            return Finding(
                "delete-permission",
                Severity.WARNING,
                "on_error.session is delete, but the API key has no permission to delete: an error leaves an unfinished "
                f"session, and the name {sequence!r} stays in use",
                help="use a key with the permission delete, or on_error.session: report",
            )
        if refusal.condition is Condition.UNAUTHENTICATED:
            raise
    return None


def _version_finding(version: str) -> Finding | None:
    """Return a warning if the server is older than the types and columns that are written."""
    if not version.startswith(_OLD_VERSIONS):
        return None
    return Finding(
        "old-server",
        Severity.WARNING,
        f"the server has version {version}: its own clients list the sequence with its topics, metadata and times, but"
        " they cannot decode the rows as their types, because tags and columns changed in 0.6",
        help="read the sequence with a client of version 0.6 or 0.7, or upgrade the server",
    )
