"""This file says before a run what its key will not let it do at the end."""

from __future__ import annotations

from mosaico_ingest.config import ServerTarget
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.platform.client import connect
from mosaico_ingest.platform.faults import Refused
from mosaico_ingest.wire import actions, bodies
from mosaico_ingest.wire.conditions import Condition

__all__ = ["delete_finding"]

_NO_SESSION = "0" * 26
"""As an identifier of a session is written; none has it."""


def delete_finding(target: ServerTarget, sequence: str) -> Finding | None:
    """Return a warning where the key may not delete; found by asking to delete what is not there.

    Raises:
        SinkError: There is no server, or it does not let us in.
    """
    question = bodies.Located(locator=bodies.session_locator(sequence, _NO_SESSION))
    try:
        with connect(target) as client:
            client.act(actions.SESSION_DELETE, question)
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
