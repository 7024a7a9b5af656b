"""This file answers the actions, each with one function."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Any

from msgspec import Struct

from mosaico_ingest import protocol
from mosaico_ingest.destinations.store.model import Note
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Action, Body
from mosaico_ingest.serve import query
from mosaico_ingest.serve.errors import Refusal, checked
from mosaico_ingest.serve.flights import split_locator
from mosaico_ingest.serve.uploads import Uploads
from mosaico_ingest.version import __version__

__all__ = ["ANSWERS", "Backend"]

_PROTOCOL = messages.SemVer(major=0, minor=7, patch=0)
_EMPTY = messages.Empty()


class Backend(Struct, frozen=True):
    """What answers are made from."""

    store: Store
    uploads: Uploads


def _info(_: Backend, __: messages.Empty) -> messages.Info:
    version = f"{_PROTOCOL.major}.{_PROTOCOL.minor}.{_PROTOCOL.patch}"
    return messages.Info(
        version=f"{version}+mosaico-ingest.{__version__}", semver=_PROTOCOL, config=messages.Limits()
    )


def _version(_: Backend, __: messages.Empty) -> messages.Version:
    return messages.Version(version=f"{_PROTOCOL.major}.{_PROTOCOL.minor}.{_PROTOCOL.patch}")


def _sequence_create(backend: Backend, question: messages.SequenceCreate) -> messages.Empty:
    with checked():
        protocol.check_sequence_name(question.locator)
        protocol.check_metadata(question.user_metadata, where=question.locator)
    backend.store.create_sequence(question.locator, question.user_metadata)
    return _EMPTY


def _sequence_delete(backend: Backend, question: messages.Located) -> messages.Empty:
    name = _sequence(question.locator)
    backend.uploads.discard_sequence(name)
    backend.store.delete_sequence(name)
    return _EMPTY


def _session_create(backend: Backend, question: messages.Located) -> messages.SessionCreated:
    opened = backend.uploads.open(_sequence(question.locator))
    return messages.SessionCreated(uuid=opened.uuid, locator=opened.locator)


def _session_finalize(backend: Backend, question: messages.SessionFinalize) -> messages.Empty:
    backend.uploads.finalize(question.session_uuid)
    return _EMPTY


def _session_delete(backend: Backend, question: messages.Located) -> messages.Empty:
    sequence, _, session = question.locator.partition(":")
    if not backend.uploads.discard_session(question.locator):
        backend.store.delete_session(_sequence(sequence), session)
    return _EMPTY


def _topic_create(backend: Backend, question: messages.TopicCreate) -> messages.TopicCreated:
    return messages.TopicCreated(uuid=backend.uploads.add_topic(question))


def _topic_delete(backend: Backend, question: messages.Located) -> messages.Empty:
    sequence, topic = _topic(question.locator)
    if not backend.uploads.discard_topic(sequence, topic):
        backend.store.delete_topic(sequence, topic)
    return _EMPTY


def _sequence_note(backend: Backend, question: messages.NotificationCreate) -> messages.Empty:
    backend.store.add_note(_sequence(question.locator), question.msg)
    return _EMPTY


def _sequence_notes(backend: Backend, question: messages.Located) -> messages.Notifications:
    notes = backend.store.sequence(_sequence(question.locator)).notes
    return _told([note for note in notes if note.topic is None], question.locator)


def _sequence_purge(backend: Backend, question: messages.Located) -> messages.Empty:
    backend.store.delete_notes(_sequence(question.locator))
    return _EMPTY


def _topic_note(backend: Backend, question: messages.NotificationCreate) -> messages.Empty:
    sequence, topic = _present(backend, question.locator)
    backend.store.add_note(sequence, question.msg, topic=topic)
    return _EMPTY


def _topic_notes(backend: Backend, question: messages.Located) -> messages.Notifications:
    sequence, topic = _present(backend, question.locator)
    notes = backend.store.sequence(sequence).notes
    return _told([note for note in notes if note.topic == topic], question.locator)


def _topic_purge(backend: Backend, question: messages.Located) -> messages.Empty:
    sequence, topic = _present(backend, question.locator)
    backend.store.delete_notes(sequence, topic=topic)
    return _EMPTY


def _query(backend: Backend, question: messages.Query) -> messages.QueryResult:
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


def _told(notes: list[Note], locator: str) -> messages.Notifications:
    return messages.Notifications(
        notifications=[
            messages.Notification(
                name=locator,
                notification_type="error",
                msg=note.message,
                created_datetime=datetime.fromtimestamp(note.created_ns / 1e9, timezone.utc).isoformat(),
            )
            for note in notes
        ]
    )


ANSWERS: Mapping[Action[Any, Any], Callable[[Backend, Any], Body]] = {
    messages.INFO: _info,
    messages.VERSION: _version,
    messages.QUERY: _query,
    messages.SEQUENCE_CREATE: _sequence_create,
    messages.SEQUENCE_DELETE: _sequence_delete,
    messages.SESSION_CREATE: _session_create,
    messages.SESSION_FINALIZE: _session_finalize,
    messages.SESSION_DELETE: _session_delete,
    messages.TOPIC_CREATE: _topic_create,
    messages.TOPIC_DELETE: _topic_delete,
    messages.SEQUENCE_NOTIFICATION_CREATE: _sequence_note,
    messages.SEQUENCE_NOTIFICATION_LIST: _sequence_notes,
    messages.SEQUENCE_NOTIFICATION_PURGE: _sequence_purge,
    messages.TOPIC_NOTIFICATION_CREATE: _topic_note,
    messages.TOPIC_NOTIFICATION_LIST: _topic_notes,
    messages.TOPIC_NOTIFICATION_PURGE: _topic_purge,
}
"""Every action this server knows, with the function that answers it."""
