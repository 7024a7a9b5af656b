"""The actions of the protocol, each handled by one function."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest import protocol
from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.destinations.store.model import Note
from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.protocol import messages
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Action, Body
from mosaico_ingest.serve import query
from mosaico_ingest.serve.flights import Uploads, split_locator
from mosaico_ingest.serve.guard import Deadline, Keyring, Refusal, StoredKey, refuse_invalid
from mosaico_ingest.version import __version__

_PROTOCOL_VERSION = messages.SemVer(major=0, minor=7, patch=0)
_EMPTY = messages.Empty()
Range: TypeAlias = tuple[int, int]
"""The first and the last timestamp in nanoseconds, both inclusive."""


class Backend(Struct, frozen=True):
    """The state that actions read and change."""

    store: Store
    uploads: Uploads
    keyring: Keyring | None = None
    request_s: float = 60.0
    """Time limit of a query, in seconds."""


def _info(_: Backend, __: messages.Empty) -> messages.Info:
    version = f"{_PROTOCOL_VERSION.major}.{_PROTOCOL_VERSION.minor}.{_PROTOCOL_VERSION.patch}"
    return messages.Info(
        version=f"{version}+mosaico-ingest.{__version__}", semver=_PROTOCOL_VERSION, config=messages.Limits()
    )


def _version(_: Backend, __: messages.Empty) -> messages.Version:
    return messages.Version(
        version=f"{_PROTOCOL_VERSION.major}.{_PROTOCOL_VERSION.minor}.{_PROTOCOL_VERSION.patch}"
    )


def _sequence_create(backend: Backend, question: messages.SequenceCreate) -> messages.Empty:
    with refuse_invalid():
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
    return _notifications([note for note in notes if note.topic is None], question.locator)


def _sequence_purge(backend: Backend, question: messages.Located) -> messages.Empty:
    backend.store.delete_notes(_sequence(question.locator))
    return _EMPTY


def _topic_note(backend: Backend, question: messages.NotificationCreate) -> messages.Empty:
    sequence, topic = _existing_topic(backend, question.locator)
    backend.store.add_note(sequence, question.msg, topic=topic)
    return _EMPTY


def _topic_notes(backend: Backend, question: messages.Located) -> messages.Notifications:
    sequence, topic = _existing_topic(backend, question.locator)
    notes = backend.store.sequence(sequence).notes
    return _notifications([note for note in notes if note.topic == topic], question.locator)


def _topic_purge(backend: Backend, question: messages.Located) -> messages.Empty:
    sequence, topic = _existing_topic(backend, question.locator)
    backend.store.delete_notes(sequence, topic=topic)
    return _EMPTY


def _query(backend: Backend, question: messages.Query) -> messages.QueryResult:
    return query.run(backend.store, question, Deadline(backend.request_s))


def _clusterize(backend: Backend, question: messages.Clusterize) -> Iterator[messages.Cluster]:
    return _numbered(_clusters(backend, question, Deadline(backend.request_s)))


def _intersect(backend: Backend, question: messages.Intersect) -> Iterator[messages.Cluster]:
    deadline = Deadline(backend.request_s)
    if len({_topic(topic.locator)[0] for topic in question.topics}) > 1:
        raise Refusal(
            Condition.INVALID, "the topics belong to several sequences; choose topics of one sequence"
        )
    clusters = [_clusters(backend, topic, deadline) for topic in question.topics]
    return _numbered(intersect(clusters, question.intersect_dt_ns))


def _clusters(backend: Backend, question: messages.Clusterize, deadline: Deadline) -> list[Range]:
    topic = backend.store.topic(*_topic(question.locator))
    if not question.ontology:
        text = f"{question.locator}: the filter has no condition; add one, such as {topic.ontology.tag}.timestamp_ns"
        raise Refusal(Condition.INVALID, text)
    times = query.matching_times(backend.store, topic, question.ontology, question.timestamp_range, deadline)
    return clusterize(times, question.clustering_dt_ns)


def _numbered(ranges: Iterable[Range]) -> Iterator[messages.Cluster]:
    for number, (start_ns, end_ns) in enumerate(ranges):
        yield messages.Cluster(ts=messages.TimeBounds(start_ns=start_ns, end_ns=end_ns), id=number)


def _key_create(backend: Backend, question: messages.KeyCreate) -> messages.KeyCreated:
    expires = None
    if question.expires_at_ns is not None:
        try:
            expires = datetime.fromtimestamp(question.expires_at_ns / 1e9, timezone.utc)
        except (ValueError, OverflowError, OSError) as error:
            raise Refusal(Condition.INVALID, f"expires_at_ns: {error}") from error
    token = _keyring(backend).add(question.permissions, description=question.description, expires=expires)
    return messages.KeyCreated(api_key_token=token)


def _key_status(backend: Backend, question: messages.KeyFingerprint) -> messages.KeyStatus:
    key = _keyring(backend).find(question.api_key_fingerprint)
    if key is None:
        raise NotInStore(f"there is no API key with the fingerprint {question.api_key_fingerprint!r}")
    return _key_status_of(key)


def _key_list(backend: Backend, _: messages.Empty) -> messages.KeyList:
    return messages.KeyList(api_keys=[_key_status_of(key) for key in _keyring(backend).keys])


def _key_revoke(backend: Backend, question: messages.KeyFingerprint) -> messages.Empty:
    if not _keyring(backend).revoke(question.api_key_fingerprint):
        raise NotInStore(f"there is no API key with the fingerprint {question.api_key_fingerprint!r}")
    return _EMPTY


def _keyring(backend: Backend) -> Keyring:
    if backend.keyring is None:
        raise Refusal(Condition.PRECONDITION, "this server does not use API keys")
    return backend.keyring


def _key_status_of(key: StoredKey) -> messages.KeyStatus:
    return messages.KeyStatus(
        api_key_fingerprint=key.fingerprint,
        created_at_ns=_nanoseconds(key.created),
        expires_at_ns=None if key.expires is None else _nanoseconds(key.expires),
        description=key.description,
        permissions=key.permission,
    )


def _nanoseconds(time: datetime) -> int:
    return round(time.timestamp() * 1e6) * 1000


def _sequence(locator: str) -> str:
    sequence, topic = split_locator(locator)
    if topic is not None:
        raise Refusal(Condition.INVALID, f"{locator!r} is not the locator of a sequence")
    return sequence


def _topic(locator: str) -> tuple[str, str]:
    sequence, topic = split_locator(locator)
    if topic is None:
        raise Refusal(Condition.INVALID, f"{locator!r} is not the locator of a topic")
    return sequence, topic


def _existing_topic(backend: Backend, locator: str) -> tuple[str, str]:
    """Return the sequence and the topic of a locator, or raise NotInStore if the topic is neither stored nor open."""
    sequence, topic = _topic(locator)
    if not backend.uploads.has_topic(sequence, topic):
        backend.store.topic(sequence, topic)
    return sequence, topic


def _notifications(notes: list[Note], locator: str) -> messages.Notifications:
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


HANDLERS: Mapping[Action[Any, Any], Callable[[Backend, Any], Body | Iterator[Body]]] = {
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
    messages.TOPIC_FILTER_CLUSTERIZE: _clusterize,
    messages.TOPIC_FILTER_INTERSECT: _intersect,
    messages.API_KEY_CREATE: _key_create,
    messages.API_KEY_STATUS: _key_status,
    messages.API_KEY_LIST: _key_list,
    messages.API_KEY_REVOKE: _key_revoke,
}
"""The function of every supported action; streamed actions return an iterator."""


def clusterize(times: NDArray[np.int64], gap_ns: int) -> list[Range]:
    """Return the ranges of sorted timestamps that gaps longer than `gap_ns` separate; 0 returns one range."""
    if not len(times):
        return []
    ends = np.flatnonzero(np.diff(times) > gap_ns) if gap_ns else np.array([], np.int64)
    starts = times[np.append(0, ends + 1)]
    return list(zip(starts.tolist(), times[np.append(ends, len(times) - 1)].tolist(), strict=True))


def intersect(clusters: Sequence[Sequence[Range]], tolerance_ns: int) -> Iterator[Range]:
    """Yield the ranges in which every topic has a cluster, as the platform's server computes them.

    The walk compares one cluster per topic and then advances the topic whose cluster ends first. Clusters that do not
    overlap but are at most `tolerance_ns` apart yield their distance, widened by half the tolerance on each side.
    """
    if not all(clusters):
        return
    positions = [0] * len(clusters)
    before_ns, after_ns = tolerance_ns // 2, tolerance_ns - tolerance_ns // 2
    while True:
        current = [ranges[position] for ranges, position in zip(clusters, positions, strict=True)]
        first_end, topic = min((end, topic) for topic, (_, end) in enumerate(current))
        last_start = max(start for start, _ in current)
        if last_start <= first_end:
            yield last_start, first_end
        elif last_start <= first_end + tolerance_ns:
            yield last_start - before_ns, first_end + after_ns
        positions[topic] += 1
        if positions[topic] == len(clusters[topic]):
            return
