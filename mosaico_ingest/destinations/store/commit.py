"""The group commit: closed sessions of a store become durable and visible together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from msgspec import Struct

from mosaico_ingest.destinations.store.errors import translate_errors
from mosaico_ingest.destinations.store.model import Claim, NewSession
from mosaico_ingest.remote import AnyPath

if TYPE_CHECKING:
    from mosaico_ingest.destinations.store.session import StoreSession


class Closed(Struct, frozen=True):
    """What a closed session commits."""

    claim: Claim
    new: NewSession
    unsynced: tuple[AnyPath, ...]
    """The staged files that may not be on the disk yet."""
    moves: Mapping[AnyPath, AnyPath]
    """The final path of each staged file."""
    obsolete: tuple[AnyPath, ...]
    """The files of the stored sequence that are in no catalog table and that the commit replaces."""


def commit_sessions(sessions: Sequence[StoreSession]) -> list[Exception | None]:
    """Commit closed sessions of one store in one transaction; return the error of each session, or None.

    If they cannot be committed together, each is committed alone, so that an error affects only its own session. If their
    files cannot be synced, all of them fail, because the system reports an error of the disk only once. A session with an
    error is discarded.
    """
    layout = sessions[0].layout
    try:
        with translate_errors(layout.root):
            layout.sync([path for session in sessions for path in session.closed.unsynced])
    except BaseException as error:
        for session in sessions:
            session.discard()
        if isinstance(error, Exception):
            return [error] * len(sessions)
        raise
    return _publish(sessions)


def _publish(sessions: Sequence[StoreSession]) -> list[Exception | None]:
    """Move the files of the sessions to their final paths, and enter the sessions in the catalog."""
    layout, catalog = sessions[0].layout, sessions[0].catalog
    contents = [session.closed for session in sessions]
    try:
        with translate_errors(layout.root):
            layout.publish({staged: final for each in contents for staged, final in each.moves.items()})
        replaced = catalog.commit([(each.claim, each.new) for each in contents])
    except BaseException as error:
        if isinstance(error, Exception) and len(sessions) > 1:
            return [result for session in sessions for result in _publish([session])]
        for session in sessions:
            session.withdraw()
        if isinstance(error, Exception):
            return [error]
        raise
    for session in sessions:
        session.leave()
    obsolete = [path for each in contents for path in each.obsolete]
    layout.remove([*(layout.root / path for path in replaced), *obsolete])
    return [None] * len(sessions)
