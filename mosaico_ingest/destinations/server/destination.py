"""A Mosaico server as a destination."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from mosaico_ingest.destinations.base import (
    Destination,
    DestinationStatus,
    ExistingSequence,
    ExistingSession,
    Sink,
)
from mosaico_ingest.destinations.server.client import connect as connect_to
from mosaico_ingest.destinations.server.sink import ServerSink, delete_finding, version_finding
from mosaico_ingest.errors import SinkError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.values import ServerTarget, SessionLevelErrorPolicy
from mosaico_ingest.protocol import messages


class ServerDestination(Destination):
    """A Mosaico server; every method but `describe` and `open_sink` connects to it."""

    kind: ClassVar[str] = "server"
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
        finished = bool(info.sessions) and all(session.locked for session in info.sessions)
        return ExistingSequence(
            name=sequence,
            complete=finished and not notifications,
            sessions=(ExistingSession("", info.user_metadata),),
            has_all_sessions=False,
            finished=finished,
        )

    def open_sink(self, *, buffer_bytes: int) -> Sink:
        """Return a sink; its sessions connect."""
        return ServerSink(self.target, buffer_bytes)

    def preflight(self, sequence: str, on_error: SessionLevelErrorPolicy) -> tuple[Finding, ...]:
        """Return warnings about an old server, and about a key that has no permission for `on_error: delete`."""
        with connect_to(self.target) as client:
            findings = [version_finding(client.version)]
            if on_error is SessionLevelErrorPolicy.Delete:
                findings.append(delete_finding(client, sequence))
        return tuple(finding for finding in findings if finding is not None)
