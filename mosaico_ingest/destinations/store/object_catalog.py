"""The catalog of a store behind a URL: one JSON document per sequence.

Object stores have no transactions, but writes of objects are atomic, and listings show all earlier writes. A writer first
writes its claim on a sequence, then lists the claims: of two writers, at least one sees the other and gives up. The
holder of the claim reads, changes and writes the document. Conditional writes would replace the claims, but pyarrow's
file systems have none; CONTRIBUTING.md compares them with obstore.
"""

from __future__ import annotations

import json
import random
import time
from base64 import b64decode, b64encode
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from io import BytesIO
from operator import itemgetter
from typing import Any, TypeVar
from urllib.parse import unquote

import msgspec
import pyarrow as pa
from pydantic import BaseModel, ConfigDict

from mosaico_ingest.destinations.base import FamilyTopic, check_same_type, sequence_exists
from mosaico_ingest.destinations.store.errors import NotInStore, sequence_changed, translate_errors
from mosaico_ingest.destinations.store.files import MARKER, ObjectFiles, encoded, new_session_id
from mosaico_ingest.destinations.store.listing import Listing, SequenceFilter, SequenceSummary
from mosaico_ingest.destinations.store.model import (
    Claim,
    MergedSegment,
    NewNote,
    NewSession,
    NewTopic,
    Note,
    Replacement,
    SegmentInfo,
    SequenceInfo,
    SessionInfo,
    TopicInfo,
    attachments_of,
    check_not_merged,
)
from mosaico_ingest.destinations.store.segment import Segment
from mosaico_ingest.destinations.store.snapshot import DOCUMENT, SUMMARY, Content, read_rows, write_snapshot
from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.job.values import PROVENANCE_KEY, IfExists
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat
from mosaico_ingest.remote import AnyPath, RemotePath

T = TypeVar("T")
FORMAT = 1
"""The version of the documents; it increases if earlier releases cannot read them."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class SegmentEntry(_Part):
    """One Parquet file."""

    path: str
    session: str
    rows: int
    bytes: int
    start_ns: int
    end_ns: int
    checksum: str | None = None
    bounds: tuple[tuple[str, Any, Any], ...] = ()
    """Path, smallest and largest value of each column with an order."""
    merged: tuple[tuple[str, str | None], ...] = ()
    """Session and checksum of each segment that compaction merged into this one."""

    @property
    def merged_segments(self) -> tuple[MergedSegment, ...]:
        """The segments that compaction merged into this one."""
        return tuple(MergedSegment(session, checksum) for session, checksum in self.merged)


class TopicEntry(_Part):
    """One topic and its segments."""

    name: str
    session: str
    ontology_tag: str
    serialization_format: SerializationFormat
    arrow_schema: str
    """An Arrow IPC schema message, in Base64."""
    metadata: dict[str, Any]
    created_ns: int
    segments: tuple[SegmentEntry, ...]

    @property
    def columns(self) -> pa.Schema:
        """Its columns."""
        return pa.ipc.read_schema(pa.py_buffer(b64decode(self.arrow_schema)))

    @property
    def ontology(self) -> OntologyType:
        """Its type."""
        return OntologyType(self.ontology_tag, pa.struct(list(self.columns)[1:]), self.serialization_format)


class SessionEntry(_Part):
    """A committed session."""

    id: str
    metadata: dict[str, Any]
    created_ns: int
    completed_ns: int


class NoteEntry(_Part):
    """An attached error."""

    topic: str | None
    message: str
    created_ns: int


class SequenceDocument(_Part):
    """One sequence."""

    format: int = FORMAT
    name: str
    metadata: dict[str, Any]
    created_ns: int
    sessions: tuple[SessionEntry, ...] = ()
    topics: tuple[TopicEntry, ...] = ()
    notes: tuple[NoteEntry, ...] = ()

    @property
    def session_ids(self) -> tuple[str, ...]:
        """Its sessions, sorted."""
        return tuple(sorted(session.id for session in self.sessions))

    @property
    def types(self) -> dict[str, OntologyType]:
        """The types of its topics."""
        return {topic.name: topic.ontology for topic in self.topics}

    @property
    def paths(self) -> list[str]:
        """The paths of all its segments."""
        return [segment.path for topic in self.topics for segment in topic.segments]

    def info(self, root: RemotePath) -> SequenceInfo:
        """Return the sequence as the model of the catalog."""
        sessions = tuple(
            SessionInfo(one.id, one.metadata, one.created_ns, one.completed_ns)
            for one in sorted(self.sessions, key=lambda one: one.id)
        )
        return SequenceInfo(
            name=self.name,
            metadata=self.metadata,
            created_ns=self.created_ns,
            sessions=sessions,
            attachments=attachments_of(sessions, root),
            topics=tuple(
                self._topic(topic, root) for topic in sorted(self.topics, key=lambda topic: topic.name)
            ),
            notes=tuple(Note(one.topic, one.message, one.created_ns) for one in self.notes),
        )

    def with_session(self, new: NewSession, *, completed_ns: int) -> SequenceDocument:
        """Return the sequence with the content of a new session."""
        entry = SessionEntry(
            id=new.id, metadata=json.loads(new.metadata), created_ns=new.created_ns, completed_ns=completed_ns
        )
        topics = {topic.name: topic for topic in self.topics}
        for topic in new.topics:
            topics[topic.name] = _joined(topics.get(topic.name), new.id, topic)
        return self.model_copy(
            update={
                "sessions": (*self.sessions, entry),
                "topics": tuple(topics.values()),
                "notes": (*self.notes, *map(_note, new.notes)),
            }
        )

    def with_replacement(self, change: Replacement) -> SequenceDocument | None:
        """Return the sequence with a merged segment, or None if one of the segments it replaces is gone."""
        document = next((topic for topic in self.topics if topic.name == change.topic), None)
        if document is None or not {one.path for one in document.segments}.issuperset(change.replaced):
            return None
        merged = _entry(change.session, change.path, change.segment).model_copy(
            update={"merged": tuple((part.session, part.checksum) for part in change.merged)}
        )
        remaining = tuple(one for one in document.segments if one.path not in change.replaced)
        changed = document.model_copy(update={"segments": (*remaining, merged)})
        topics = tuple(changed if topic is document else topic for topic in self.topics)
        return self.model_copy(update={"topics": topics})

    def with_note(self, new: NewNote) -> SequenceDocument:
        """Return the sequence with a new note."""
        return self.model_copy(update={"notes": (*self.notes, _note(new))})

    def without_notes(self, topic: str | None) -> SequenceDocument:
        """Return the sequence without its own notes, or without the notes of a topic."""
        return self.model_copy(update={"notes": tuple(one for one in self.notes if one.topic != topic)})

    def without_topic(self, name: str) -> SequenceDocument:
        """Return the sequence without a topic; raises NotInStore if the topic does not exist."""
        rest = tuple(topic for topic in self.topics if topic.name != name)
        if len(rest) == len(self.topics):
            raise NotInStore(f"there is no topic {name!r}", where=self.name)
        return self.without_notes(name).model_copy(update={"topics": rest})

    def without_session(self, session: str) -> SequenceDocument:
        """Return the sequence without the content of a session; raises NotInStore if the session does not exist."""
        rest = tuple(one for one in self.sessions if one.id != session)
        if len(rest) == len(self.sessions):
            raise NotInStore(f"there is no session {session!r}", where=self.name)
        check_not_merged(
            session, self.name, (one.merged_segments for each in self.topics for one in each.segments)
        )
        topics = (
            topic.model_copy(
                update={"segments": tuple(one for one in topic.segments if one.session != session)}
            )
            for topic in self.topics
        )
        remaining = tuple(topic for topic in topics if topic.segments or topic.session != session)
        return self.model_copy(update={"sessions": rest, "topics": remaining})

    def _topic(self, topic: TopicEntry, root: RemotePath) -> TopicInfo:
        segments = sorted(topic.segments, key=lambda one: (one.start_ns, one.session, one.path))
        return TopicInfo(
            sequence=self.name,
            name=topic.name,
            session=topic.session,
            ontology=topic.ontology,
            schema=topic.columns,
            metadata=topic.metadata,
            created_ns=topic.created_ns,
            segments=tuple(_segment(one, root) for one in segments),
        )


def check_unchanged(claimed: Claim, now: SequenceDocument | None) -> None:
    """Check that a sequence has not changed since the claim.

    Raises:
        SequenceExists: The sequence exists now, but must not exist.
        SinkError: Another session changed the sequence.
    """
    if now is not None and claimed.if_exists in {IfExists.FAIL, IfExists.SKIP}:
        raise sequence_exists(claimed.sequence)
    if claimed.sequence_id is not None and (now is None or now.created_ns != claimed.sequence_id):
        raise sequence_changed(claimed.sequence)
    if claimed.if_exists is IfExists.REPLACE and now is not None and now.session_ids != claimed.sessions:
        raise sequence_changed(claimed.sequence)


def _joined(held: TopicEntry | None, session: str, new: NewTopic) -> TopicEntry:
    added = tuple(_entries(session, new))
    if held is not None:
        check_same_type(held.ontology, new.ontology, where=new.name)
        return held.model_copy(update={"segments": (*held.segments, *added)})
    return TopicEntry(
        name=new.name,
        session=session,
        ontology_tag=new.ontology.tag,
        serialization_format=new.ontology.serialization_format,
        arrow_schema=b64encode(new.schema.serialize().to_pybytes()).decode(),
        metadata=json.loads(new.metadata),
        created_ns=new.created_ns,
        segments=added,
    )


def _entries(session: str, new: NewTopic) -> Iterator[SegmentEntry]:
    for path, segment in new.segments.items():
        yield _entry(session, path, segment)


def _entry(session: str, path: str, segment: Segment) -> SegmentEntry:
    return SegmentEntry(
        path=path,
        session=session,
        rows=segment.rows,
        bytes=segment.stored_bytes,
        start_ns=segment.start_ns,
        end_ns=segment.end_ns,
        checksum=segment.checksum,
        bounds=segment.bounds,
    )


def _segment(entry: SegmentEntry, root: RemotePath) -> SegmentInfo:
    return SegmentInfo(
        path=root / entry.path,
        session=entry.session,
        rows=entry.rows,
        stored_bytes=entry.bytes,
        start_ns=entry.start_ns,
        end_ns=entry.end_ns,
        checksum=entry.checksum,
        merged=entry.merged_segments,
    )


def _note(new: NewNote) -> NoteEntry:
    return NoteEntry(topic=new.topic, message=new.message, created_ns=new.created_ns)


_SUFFIX = ".json"
_THREADS = 16
MAX_TAIL = 1000
"""Number of documents above which a reader writes a snapshot first."""
_LONGEST_NAME = 200
"""Object names do not contain longer sequence names in full."""
_READS = 3
"""Number of attempts to read a document that is replaced at the same time."""
_TRIES, _PAUSE_S = 8, 0.25


class ObjectCatalog:
    """The catalog of the store in `bucket`, which `create` creates if necessary; see `StoreCatalog`."""

    def __init__(self, bucket: ObjectFiles, *, create: bool) -> None:
        self._bucket = bucket
        self._root = bucket.root
        marker = self._root / MARKER
        with translate_errors(self._root):
            try:
                version = _number(marker.read_bytes())
            except FileNotFoundError:
                if not create:
                    raise SinkError(
                        "there is no store here", where=str(self._root), hint="check the URL"
                    ) from None
                marker.write_bytes(json.dumps({"format": FORMAT}).encode())
                version = FORMAT
        if version > FORMAT:
            raise SinkError(
                f"the store has format {version}, this version supports up to {FORMAT}",
                where=str(self._root),
                hint="upgrade mosaico-ingest",
            )

    def keep_open(self) -> BytesIO:
        """See `StoreCatalog.keep_open`; requests are independent, so the handle does nothing."""
        return BytesIO()

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """See `StoreCatalog.claim`."""
        document = self._load(sequence)
        if document is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)
        if if_exists is not IfExists.APPEND:
            self._reserve(session, sequence, is_live)
        if document is None:
            return Claim(sequence, if_exists, None, (), {})
        types = document.types if if_exists is IfExists.APPEND else {}
        return Claim(sequence, if_exists, document.created_ns, document.session_ids, types)

    def commit(self, sessions: Sequence[tuple[Claim, NewSession]]) -> list[str]:
        """See `StoreCatalog.commit`; a document is a transaction of its own."""
        return [path for claimed, new in sessions for path in self._commit(claimed, new)]

    def _commit(self, claimed: Claim, new: NewSession) -> list[str]:
        if claimed.if_exists is IfExists.APPEND:
            with self._holding(claimed.sequence, session=new.id):
                return self._enter(claimed, new)
        with translate_errors(self._root):
            if not self._claim(new.id, claimed.sequence).exists():
                raise sequence_changed(claimed.sequence)
        replaced = self._enter(claimed, new)
        with suppress(SinkError):  # the document is committed; a claim without a live session is ignored
            self.release(new.id, claimed.sequence)
        return replaced

    def replace_segments(self, change: Replacement) -> bool:
        """See `StoreCatalog.replace_segments`."""
        with self._holding(change.sequence):
            document = self._load(change.sequence)
            changed = None if document is None else document.with_replacement(change)
            if changed is not None:
                self._put(changed)
        return changed is not None

    def release(self, session: str, sequence: str) -> None:
        """See `StoreCatalog.release`."""
        with translate_errors(self._root), suppress(FileNotFoundError):
            self._claim(session, sequence).unlink()

    def create(self, sequence: str, metadata: str) -> None:
        """See `StoreCatalog.create`."""
        with self._holding(sequence):
            if self._load(sequence) is not None:
                raise sequence_exists(sequence)
            described = json.loads(metadata)
            self._put(SequenceDocument(name=sequence, metadata=described, created_ns=time.time_ns()))

    def note(self, sequence: str, new: NewNote) -> None:
        """See `StoreCatalog.note`."""
        with self._holding(sequence):
            self._put(self._known(sequence).with_note(new))

    def names(self) -> list[str]:
        """See `StoreCatalog.names`."""
        return sorted(self._name(path) for path in self._paths())

    def sequence(self, name: str) -> SequenceInfo | None:
        """See `StoreCatalog.sequence`."""
        document = self._load(name)
        return None if document is None else document.info(self._root)

    def headers(self, names: Collection[str]) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.headers`; reads one document per sequence."""
        return tuple(self._infos(list(names)))

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.sequences`; the sequences are not read at the same moment."""
        return tuple(one.info(self._root) for one in self._all())

    def listing(self, selection: SequenceFilter, *, after: str | None, limit: int | None) -> Listing:
        """See `StoreCatalog.listing`; long pages and filters of the content use the snapshot of the catalog."""
        names = [
            name for name in self.names() if selection.match is None or fnmatchcase(name, selection.match)
        ]
        matches: dict[str, SequenceSummary] | None = None
        if selection.metadata or selection.incomplete:
            matches = {one.name: one for one in self._summaries(names) if selection.selects(one)}
            names = list(matches)
        rest = [name for name in names if after is None or name > after]
        page = rest[:limit]
        summaries = self._summaries(page) if matches is None else [matches[name] for name in page]
        return Listing(tuple(summaries), len(names), page[-1] if page and len(page) < len(rest) else None)

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...]:
        """See `StoreCatalog.family_topics`."""
        topics: list[tuple[str, FamilyTopic]] = []
        for info in self.sequences():
            sessions = {
                one.id
                for one in info.sessions
                if (one.metadata.get(PROVENANCE_KEY) or {}).get("family") == family
            }
            topics += [
                (topic.session, FamilyTopic(info.name, topic.name, topic.metadata))
                for topic in info.topics
                if topic.name in names and topic.session in sessions
            ]
        return tuple(topic for _, topic in sorted(topics, key=itemgetter(0)))

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """See `StoreCatalog.bounds`."""
        document = self._load(topic.sequence)
        segments = [
            segment
            for one in (document.topics if document else ())
            if one.name == topic.name
            for segment in one.segments
        ]
        return {
            self._root / segment.path: {
                name: (low, high) for name, low, high in segment.bounds if name in columns
            }
            for segment in segments
        }

    def delete_sequence(self, sequence: str) -> list[str]:
        """See `StoreCatalog.delete_sequence`."""
        with self._holding(sequence):
            document = self._known(sequence)
            with translate_errors(self._root):
                self._document(sequence).unlink()
        return document.paths

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """See `StoreCatalog.delete_topic`."""
        return self._change(sequence, lambda found: found.without_topic(topic))

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """See `StoreCatalog.delete_session`."""
        return self._change(sequence, lambda found: found.without_session(session))

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """See `StoreCatalog.delete_notes`."""
        self._change(sequence, lambda found: found.without_notes(topic))

    def forget(self, live: Collection[str]) -> set[str]:
        """See `StoreCatalog.forget`."""
        with translate_errors(self._root):
            for claim in (self._root / "claims").listing(recursive=True):
                if claim.is_file() and claim.name not in live:
                    with suppress(FileNotFoundError):
                        claim.unlink()
        return {path for one in self._all() for path in one.paths}

    def _enter(self, claimed: Claim, new: NewSession) -> list[str]:
        """Write the document with the session, which makes it visible; return the replaced segments."""
        now = self._load(claimed.sequence)
        check_unchanged(claimed, now)
        replaces = claimed.if_exists is IfExists.REPLACE
        base = now if now and not replaces else None
        base = base or SequenceDocument(
            name=claimed.sequence, metadata=json.loads(new.metadata), created_ns=new.created_ns
        )
        self._put(base.with_session(new, completed_ns=time.time_ns()))
        return now.paths if now and replaces else []

    def _change(self, sequence: str, change: Callable[[SequenceDocument], SequenceDocument]) -> list[str]:
        """Apply a change to a document; return the segments that it no longer contains."""
        with self._holding(sequence):
            document = self._known(sequence)
            changed = change(document)
            self._put(changed)
        return sorted(set(document.paths) - set(changed.paths))

    def _known(self, sequence: str) -> SequenceDocument:
        document = self._load(sequence)
        if document is None:
            raise NotInStore(f"there is no sequence {sequence!r}")
        return document

    @contextmanager
    def _holding(self, sequence: str, *, session: str | None = None) -> Generator[None, None, None]:
        """Hold the claim on a sequence during the context, after waiting for other holders."""
        holder = session or new_session_id()
        if session is None:
            self._bucket.begin(holder).release()
        try:
            self._wait_for(holder, sequence)
            try:
                yield
            finally:
                self.release(holder, sequence)
        finally:
            if session is None:
                self._bucket.discard(holder)

    def _wait_for(self, holder: str, sequence: str) -> None:
        for tries_left in reversed(range(_TRIES)):
            try:
                self._reserve(holder, sequence, self._bucket.is_live)
            except SequenceExists as err:  # noqa: PERF203 - each try may find another holder
                if not tries_left:
                    raise SinkUnavailable(err.what, where=err.where, hint=err.hint) from err
                time.sleep(_PAUSE_S * (0.5 + random.random()))  # noqa: S311 - spreads the retries of two writers
            else:
                return

    def _reserve(self, session: str, sequence: str, is_live: Callable[[str], bool]) -> None:
        """Claim a sequence, then check for other claims; see the module docstring."""
        own = self._claim(session, sequence)
        with translate_errors(self._root):
            own.write_bytes(b"")
            others = [one for one in own.parent.iterdir() if one.is_file() and one.name != session]
            for other in others:
                if is_live(other.name):
                    own.unlink()
                    raise SequenceExists(
                        "another run is writing this sequence", where=sequence, hint="wait for it"
                    )
                with suppress(FileNotFoundError):
                    other.unlink()

    def _document(self, sequence: str) -> RemotePath:
        return self._root / f"catalog/{encoded(sequence)}{_SUFFIX}"

    def _claim(self, session: str, sequence: str) -> RemotePath:
        return self._root / f"claims/{encoded(sequence)}/{session}"

    def _paths(self) -> list[RemotePath]:
        with translate_errors(self._root):
            below = (self._root / "catalog").iterdir()
            return [path for path in below if path.is_file() and path.suffix == _SUFFIX]

    def _name(self, path: RemotePath) -> str:
        name = path.name.removesuffix(_SUFFIX)
        return self._read(path).name if len(name) > _LONGEST_NAME else unquote(name)

    def _all(self) -> list[SequenceDocument]:
        documents = self._current(DOCUMENT, SequenceDocument.model_validate_json, lambda document: document)
        return sorted(documents, key=lambda one: one.name)

    def _summaries(self, names: Sequence[str]) -> list[SequenceSummary]:
        """Return the summaries of the sequences that still exist, in the order of the names."""
        if len(names) <= MAX_TAIL:
            return list(map(SequenceSummary.of, self._infos(names)))
        summaries = {one.name: one for one in self._current(SUMMARY, _decode_summary, self._summary)}
        return [summaries[name] for name in names if name in summaries]

    def _summary(self, document: SequenceDocument) -> SequenceSummary:
        return SequenceSummary.of(document.info(self._root))

    def _current(
        self, column: str, decode: Callable[[bytes], T], derive: Callable[[SequenceDocument], T]
    ) -> list[T]:
        """Return a value for each sequence, from the snapshot or, if it changed since, from its document."""
        documents = self._listed()
        rows = read_rows(self._root, column, documents)
        if len(documents) - len(rows) > MAX_TAIL:
            with suppress(SinkError):  # readers may not be allowed to write
                write_snapshot(self._root, self._listed, self._contents)
                rows = read_rows(self._root, column, documents)
        tail = [path for key, path in documents.items() if key not in rows]
        return [
            *map(decode, rows.values()),
            *(derive(one) for one in self._read_all(tail) if one is not None),
        ]

    def _contents(self, paths: Sequence[RemotePath]) -> list[Content | None]:
        """Return the snapshot row of each document, None if the document no longer exists."""
        return [
            None
            if document is None
            else Content(msgspec.json.encode(self._summary(document)), _encoded_document(document))
            for document in self._read_all(paths)
        ]

    def _listed(self) -> dict[str, RemotePath]:
        return {path.name: path for path in self._paths()}

    def _read_all(self, paths: Sequence[RemotePath]) -> list[SequenceDocument | None]:
        with ThreadPoolExecutor(_THREADS, thread_name_prefix="catalog") as pool:
            return list(pool.map(self._read_or_none, paths))

    def _read_or_none(self, path: RemotePath) -> SequenceDocument | None:
        try:
            return self._read(path)
        except NotInStore:
            return None

    def _infos(self, names: Iterable[str]) -> list[SequenceInfo]:
        """Return the sequences of these names that still exist, in the order of the names."""
        with ThreadPoolExecutor(_THREADS, thread_name_prefix="catalog") as pool:
            return [info for info in pool.map(self.sequence, names) if info is not None]

    def _load(self, sequence: str) -> SequenceDocument | None:
        return self._read_or_none(self._document(sequence))

    def _read(self, path: RemotePath) -> SequenceDocument:
        with translate_errors(path):
            try:
                for _ in range(_READS - 1):
                    # pyarrow asks for the size first, so a document that a writer replaces meanwhile may end early.
                    with suppress(ValueError):
                        return _parsed(path)
                return _parsed(path)
            except FileNotFoundError as err:
                raise NotInStore("it is not in the catalog", where=str(path)) from err
            except ValueError as err:
                problem = str(err).splitlines()[0]
                raise SinkError(f"the document cannot be read: {problem}", where=str(path)) from err

    def _put(self, document: SequenceDocument) -> None:
        with translate_errors(self._root):
            self._document(document.name).write_bytes(_encoded_document(document))


def _parsed(path: RemotePath) -> SequenceDocument:
    return SequenceDocument.model_validate(json.loads(path.read_bytes()))


def _encoded_document(document: SequenceDocument) -> bytes:
    return json.dumps(document.model_dump(mode="python"), default=str).encode()


def _decode_summary(content: bytes) -> SequenceSummary:
    return msgspec.json.decode(content, type=SequenceSummary)


def _number(marker: bytes) -> int:
    try:
        return int(json.loads(marker)["format"])
    except (ValueError, KeyError, TypeError) as err:
        raise SinkError(f"{MARKER} does not contain the format of the store", hint="check the URL") from err
