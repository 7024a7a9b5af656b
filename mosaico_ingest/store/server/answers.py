"""This file answers the actions, each with one function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Any

from mosaico_ingest import wire
from mosaico_ingest.frozen import frozen
from mosaico_ingest.store.model import Note
from mosaico_ingest.store.server import query
from mosaico_ingest.store.server.flights import split_locator
from mosaico_ingest.store.server.refusals import Refusal, checked
from mosaico_ingest.store.server.uploads import Uploads
from mosaico_ingest.store.store import Store
from mosaico_ingest.version import __version__
from mosaico_ingest.wire import actions, bodies
from mosaico_ingest.wire.actions import Action
from mosaico_ingest.wire.bodies import Body
from mosaico_ingest.wire.conditions import Condition

__all__ = ["ANSWERS", "Backend"]

_PROTOCOL = bodies.SemVer(major=0, minor=7, patch=0)
_EMPTY = bodies.Empty()


@frozen
class Backend:
    """What answers are made from."""

    store: Store
    uploads: Uploads


def _info(_: Backend, __: bodies.Empty) -> bodies.Info:
    version = f"{_PROTOCOL.major}.{_PROTOCOL.minor}.{_PROTOCOL.patch}"
    return bodies.Info(
        version=f"{version}+mosaico-ingest.{__version__}", semver=_PROTOCOL, config=bodies.Limits()
    )


def _version(_: Backend, __: bodies.Empty) -> bodies.Version:
    return bodies.Version(version=f"{_PROTOCOL.major}.{_PROTOCOL.minor}.{_PROTOCOL.patch}")


def _sequence_create(backend: Backend, question: bodies.SequenceCreate) -> bodies.Empty:
    with checked():
        wire.check_sequence_name(question.locator)
        wire.check_metadata(question.user_metadata, where=question.locator)
    backend.store.create_sequence(question.locator, question.user_metadata)
    return _EMPTY


def _sequence_delete(backend: Backend, question: bodies.Located) -> bodies.Empty:
    name = _sequence(question.locator)
    backend.uploads.discard_sequence(name)
    backend.store.delete_sequence(name)
    return _EMPTY


def _session_create(backend: Backend, question: bodies.Located) -> bodies.SessionCreated:
    opened = backend.uploads.open(_sequence(question.locator))
    return bodies.SessionCreated(uuid=opened.uuid, locator=opened.locator)


def _session_finalize(backend: Backend, question: bodies.SessionFinalize) -> bodies.Empty:
    backend.uploads.finalize(question.session_uuid)
    return _EMPTY


def _session_delete(backend: Backend, question: bodies.Located) -> bodies.Empty:
    sequence, _, session = question.locator.partition(":")
    if not backend.uploads.discard_session(question.locator):
        backend.store.delete_session(_sequence(sequence), session)
    return _EMPTY


def _topic_create(backend: Backend, question: bodies.TopicCreate) -> bodies.TopicCreated:
    return bodies.TopicCreated(uuid=backend.uploads.add_topic(question))


def _topic_delete(backend: Backend, question: bodies.Located) -> bodies.Empty:
    sequence, topic = _topic(question.locator)
    if not backend.uploads.discard_topic(sequence, topic):
        backend.store.delete_topic(sequence, topic)
    return _EMPTY


def _sequence_note(backend: Backend, question: bodies.NotificationCreate) -> bodies.Empty:
    backend.store.add_note(_sequence(question.locator), question.msg)
    return _EMPTY


def _sequence_notes(backend: Backend, question: bodies.Located) -> bodies.Notifications:
    notes = backend.store.sequence(_sequence(question.locator)).notes
    return _told([note for note in notes if note.topic is None], question.locator)


def _sequence_purge(backend: Backend, question: bodies.Located) -> bodies.Empty:
    backend.store.delete_notes(_sequence(question.locator))
    return _EMPTY


def _topic_note(backend: Backend, question: bodies.NotificationCreate) -> bodies.Empty:
    sequence, topic = _present(backend, question.locator)
    backend.store.add_note(sequence, question.msg, topic=topic)
    return _EMPTY


def _topic_notes(backend: Backend, question: bodies.Located) -> bodies.Notifications:
    sequence, topic = _present(backend, question.locator)
    notes = backend.store.sequence(sequence).notes
    return _told([note for note in notes if note.topic == topic], question.locator)


def _topic_purge(backend: Backend, question: bodies.Located) -> bodies.Empty:
    sequence, topic = _present(backend, question.locator)
    backend.store.delete_notes(sequence, topic=topic)
    return _EMPTY


def _query(backend: Backend, question: bodies.Query) -> bodies.QueryResult:
    return query.run(backend.store, question)


def _sequence(locator: str) -> str:
    sequence, topic = split_locator(locator)
    if topic is not None:
        raise Refusal(Condition.INVALID, f"{locator!r} is no sequence")
    return sequence


def _topic(locator: str) -> tuple[str, str]:
    sequence, topic = split_locator(locator)
    if topic is None:
        raise Refusal(Condition.INVALID, f"{locator!r} is no topic")
    return sequence, topic


def _present(backend: Backend, locator: str) -> tuple[str, str]:
    sequence, topic = _topic(locator)
    if not backend.uploads.has_topic(sequence, topic):
        backend.store.topic(sequence, topic)
    return sequence, topic


def _told(notes: list[Note], locator: str) -> bodies.Notifications:
    return bodies.Notifications(
        notifications=[
            bodies.Notification(
                name=locator,
                notification_type="error",
                msg=note.message,
                created_datetime=datetime.fromtimestamp(note.created_ns / 1e9, timezone.utc).isoformat(),
            )
            for note in notes
        ]
    )


ANSWERS: Mapping[Action[Any, Any], Callable[[Backend, Any], Body]] = {
    actions.INFO: _info,
    actions.VERSION: _version,
    actions.QUERY: _query,
    actions.SEQUENCE_CREATE: _sequence_create,
    actions.SEQUENCE_DELETE: _sequence_delete,
    actions.SESSION_CREATE: _session_create,
    actions.SESSION_FINALIZE: _session_finalize,
    actions.SESSION_DELETE: _session_delete,
    actions.TOPIC_CREATE: _topic_create,
    actions.TOPIC_DELETE: _topic_delete,
    actions.SEQUENCE_NOTIFICATION_CREATE: _sequence_note,
    actions.SEQUENCE_NOTIFICATION_LIST: _sequence_notes,
    actions.SEQUENCE_NOTIFICATION_PURGE: _sequence_purge,
    actions.TOPIC_NOTIFICATION_CREATE: _topic_note,
    actions.TOPIC_NOTIFICATION_LIST: _topic_notes,
    actions.TOPIC_NOTIFICATION_PURGE: _topic_purge,
}
"""Every action this server knows, with the function that answers it."""
