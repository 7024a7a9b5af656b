"""This file is a writing session on a server: what it wrote becomes visible when it is finalized, or is deleted."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from mosaico_ingest import protocol
from mosaico_ingest.destinations.base import StoredTopic, sequence_exists
from mosaico_ingest.destinations.server.client import PlatformClient, Uploaded, connect, in_thread
from mosaico_ingest.destinations.server.errors import Refused, add_hint
from mosaico_ingest.destinations.server.upload import Memory, Upload
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.job.values import IfExists, ServerTarget
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Action, topic_locator

__all__ = ["PlatformSession"]

_OLD_IS_GONE = "the old sequence is deleted"
_FILL = 0.9
"""How full a message may be; the rest is left to what Flight and gRPC add."""


class PlatformSession:
    """One writing session; `commit` or `discard` ends it."""

    def __init__(
        self,
        target: ServerTarget,
        client: PlatformClient,
        sequence: str,
        metadata: str,
        *,
        if_exists: IfExists,
        buffer_bytes: int,
    ) -> None:
        self._target = target
        self._client = client
        self._sequence = sequence
        self._memory = Memory(most_bytes=buffer_bytes)
        self._uploads: dict[str, Upload] = {}
        self._given: dict[str, str] = {}
        self._notes: list[tuple[str | None, str]] = []
        self._session: messages.SessionCreated | None = None
        old = client.find(sequence)
        self._held = _topics_of(old) if old and if_exists is IfExists.APPEND else frozenset[str]()
        self._created = old is None or if_exists is not IfExists.APPEND
        if old is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)
        self._replaced = old is not None and if_exists is IfExists.REPLACE
        if self._replaced:
            client.act(messages.SEQUENCE_DELETE, messages.Located(locator=sequence))
        if self._created:
            self._create(metadata)

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> Upload:
        """Open a topic; see `Session.topic`."""
        path = protocol.check_topic_name(name)
        described: dict[str, Any] = json.loads(protocol.check_metadata(metadata, where=name))
        if path in self._uploads:
            raise SinkError("the topic is open already", where=name)
        locator = topic_locator(self._sequence, path)
        if locator in self._held:
            hint = "rename it in topic_settings, or replace the sequence"
            raise SinkError(
                "the sequence has this topic, and a server adds no rows to one", where=name, hint=hint
            )
        question = messages.TopicCreate(
            session_uuid=self._open_session().uuid,
            locator=locator,
            serialization_format=ontology.serialization_format,
            ontology_tag=ontology.tag,
            user_metadata=described,
        )
        created = self._client.act(messages.TOPIC_CREATE, question)
        put = messages.Put(resource_locator=locator, topic_uuid=created.uuid)
        upload = Upload(
            name,
            ontology,
            lambda schema: self._client.put(put, schema),
            message_bytes=int(self._client.message_bytes * _FILL),
            memory=self._memory,
            address=self._client.address,
        )
        self._uploads[path] = upload
        self._given[name] = path
        return upload

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error; see `Session.note_error`. It is sent with the commit."""
        self._notes.append((None if topic is None else protocol.check_topic_name(topic), message))

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return what the server says over a new connection; see `Session.stored`."""
        with connect(self._target, handshake=False) as client:
            held = client.uploaded(self._sequence) if self._uploads else {}
            return tuple(self._stored(client, held, name, path) for name, path in self._given.items())

    def commit(self) -> None:
        """Wait until the server has every topic, then make them visible at once."""
        self._drop_broken()
        for closing in [in_thread(upload.close) for upload in self._uploads.values()]:
            closing.result()
        for path, message in self._notes:
            self._send_note(path, message)
        session = self._session
        if session is None:
            return
        if self._uploads:
            question = messages.SessionFinalize(session_uuid=session.uuid)
            self._surely(messages.SESSION_FINALIZE, question, lambda: self._is_final(session))
        else:
            self._delete_session(session)

    def discard(self) -> str | None:
        """Leave no trace; return what had to stay behind or is lost, None where nothing is."""
        for ending in [in_thread(upload.abandon) for upload in self._uploads.values()]:
            ending.result()
        remarks = [self._remove()]
        if self._replaced:
            remarks.append(_OLD_IS_GONE)
        return "; ".join(remark for remark in remarks if remark) or None

    def _remove(self) -> str | None:
        try:
            if self._session is not None:
                self._delete_session(self._session)
            if self._created:
                self._client.act(messages.SEQUENCE_DELETE, messages.Located(locator=self._sequence))
        except Refused as refusal:
            if refusal.condition is not Condition.NOT_FOUND:
                return f"an unfinished session of {self._sequence} stays on the server ({refusal.what})"
        except SinkError as error:
            return f"an unfinished session of {self._sequence} may stay on the server ({error.what})"
        return None

    def _create(self, metadata: str) -> None:
        question = messages.SequenceCreate(locator=self._sequence, user_metadata=json.loads(metadata))
        try:
            self._surely(
                messages.SEQUENCE_CREATE, question, lambda: self._client.find(self._sequence) is not None
            )
        except SinkError as error:
            if isinstance(error, Refused) and error.condition is Condition.EXISTS:
                raise sequence_exists(self._sequence) from error
            if self._replaced:
                add_hint(error, _OLD_IS_GONE)
            raise

    def _open_session(self) -> messages.SessionCreated:
        """Create the session with its first topic, since a server refuses to finalize an empty one."""
        if self._session is None:
            self._session = self._client.act(
                messages.SESSION_CREATE, messages.Located(locator=self._sequence)
            )
        return self._session

    def _drop_broken(self) -> None:
        """Delete the topics whose streams broke, as their errors were raised; the others stay."""
        for path, upload in tuple(self._uploads.items()):
            if upload.broken is not None:
                del self._uploads[path]
                self._memory.uploads.remove(upload)
                locator = topic_locator(self._sequence, path)
                self._client.act(messages.TOPIC_DELETE, messages.Located(locator=locator))

    def _send_note(self, path: str | None, message: str) -> None:
        if path in self._uploads:
            locator = topic_locator(self._sequence, path)
            note = messages.NotificationCreate(locator=locator, msg=message)
            self._client.act(messages.TOPIC_NOTIFICATION_CREATE, note)
        else:
            text = f"{path}: {message}" if path else message
            note = messages.NotificationCreate(locator=self._sequence, msg=text)
            self._client.act(messages.SEQUENCE_NOTIFICATION_CREATE, note)

    def _surely(self, action: Action[Any, Any], question: messages.Body, is_done: Callable[[], bool]) -> None:
        """Act; where the answer was lost, look whether it happened before asking again."""
        try:
            self._client.act(action, question)
        except SinkUnavailable:
            if not is_done():
                self._client.act(action, question)

    def _is_final(self, session: messages.SessionCreated) -> bool:
        found = self._client.find(self._sequence)
        return found is not None and any(s.locked for s in found.sessions if s.locator == session.locator)

    def _delete_session(self, session: messages.SessionCreated) -> None:
        self._client.act(messages.SESSION_DELETE, messages.Located(locator=session.locator))

    def _stored(
        self, client: PlatformClient, held: Mapping[str, Uploaded], name: str, path: str
    ) -> StoredTopic:
        if path not in self._uploads:
            return StoredTopic(name, 0, None, None, 0)
        locator = topic_locator(self._sequence, path)
        found = held[locator] if locator in held else client.counted(locator)
        return StoredTopic(name, found.rows, found.start_ns, found.end_ns, found.stored_bytes)


def _topics_of(sequence: messages.SequenceInfo) -> frozenset[str]:
    return frozenset(locator for session in sequence.sessions for locator in session.topics)
