"""The catalog of a store behind a URL: one JSON document per sequence.

Object stores have no transactions, but writes of objects are atomic, and listings show all earlier writes. A writer first
writes its claim on a sequence, then lists the claims: of two writers, at least one sees the other and gives up. The
holder of the claim reads, changes and writes the document. Conditional writes would replace the claims, but pyarrow's
file systems have none; CONTRIBUTING.md compares them with obstore.

Listings read neither all documents nor the list of all documents, but the latest snapshot and its tail: the documents of
sequences that are claimed or named by a change. Four rules make this complete without conditional writes:

1. A writer claims a sequence, writes its document, then a change that names it, and then releases the claim. Whoever
   removes the claim of a dead writer writes the change first.
2. A reader lists claims, changes and snapshots, in this order. Each object appears before its predecessor disappears.
3. The writer of a snapshot lists changes, snapshots and documents, in this order, reads the documents, publishes the
   snapshot under the next number, and then removes the changes that it listed. Since these changes were written after their
   documents, the snapshot contains them.
4. If two writers publish the same number, one may have removed changes that the other does not contain. Readers then use
   neither, but the list of all documents, until somebody publishes the next number. A snapshot with a lower number is
   ignored: its writer listed the documents before the writers of later numbers did.

A snapshot is a cache: without one, or if it is damaged, readers list and read all documents. Garbage collection always lists
them, because it removes files.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from fnmatch import fnmatchcase
from io import BytesIO
from operator import itemgetter
from typing import Any, TypeVar
from urllib.parse import unquote

import msgspec
from msgspec import Struct

from mosaico_ingest.destinations import FamilyTopic, sequence_exists
from mosaico_ingest.destinations.store.documents import (
    DOCUMENT,
    FORMAT,
    SUMMARY,
    Content,
    DamagedSnapshot,
    SequenceDocument,
    Snapshot,
    Snapshots,
    changed_key,
    check_unchanged,
    list_changes,
    write_snapshot,
)
from mosaico_ingest.destinations.store.files import (
    CHANGES,
    CLAIMS,
    MARKER,
    NotInStore,
    ObjectFiles,
    encoded,
    new_session_id,
    sequence_changed,
    translate_errors,
)
from mosaico_ingest.destinations.store.model import (
    Claim,
    Listing,
    NewNote,
    NewSession,
    Replacement,
    SequenceFilter,
    SequenceInfo,
    SequenceSummary,
    TopicInfo,
)
from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.job.values import PROVENANCE_KEY, IfExists
from mosaico_ingest.remote import AnyPath, RemotePath

T = TypeVar("T")

_SUFFIX = ".json"
_THREADS = 16
MAX_TAIL = 1000
"""Number of changes, or of documents that no snapshot contains, above which a reader writes a snapshot first."""
_LONGEST_NAME = 200
"""Object names do not contain longer sequence names in full."""
_READS = 3
"""Number of attempts to read a document that is replaced at the same time."""
_TRIES, _PAUSE_S = 8, 0.25


class View(Struct, frozen=True):
    """The sequences of a catalog at one moment, where each is found by name, in the order of names."""

    snapshot: Snapshot | None
    entries: Mapping[str, int | RemotePath | SequenceDocument]
    """A position in the snapshot, or a document."""


class ObjectCatalog:
    """The catalog of the store in `bucket`, which `create` creates if necessary; see `StoreCatalog`."""

    def __init__(self, bucket: ObjectFiles, *, create: bool) -> None:
        self._bucket = bucket
        self._root = bucket.root
        self._unmarked: set[str] = set()
        """The keys of documents that may be written and whose change is not; their claims must not be removed."""
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
        """See `StoreCatalog.release`; writes a change first if the document may have been written."""
        if encoded(sequence) in self._unmarked:
            self._mark(encoded(sequence))
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
        return list(self._view().entries)

    def sequence(self, name: str) -> SequenceInfo | None:
        """See `StoreCatalog.sequence`."""
        document = self._load(name)
        return None if document is None else document.info(self._root)

    def headers(self, names: Collection[str]) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.headers`; many names use the snapshot of the catalog, others a document each."""
        if len(names) <= MAX_TAIL:
            return tuple(self._infos(list(names)))
        selected = set(names)
        documents = self._query(lambda view: self._documents(view, list(view.entries.keys() & selected)))
        return tuple(one.info(self._root) for one in documents)

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """See `StoreCatalog.sequences`; the sequences are not read at the same moment."""
        return tuple(one.info(self._root) for one in self._all())

    def listing(self, selection: SequenceFilter, *, after: str | None, limit: int | None) -> Listing:
        """See `StoreCatalog.listing`; reads the summaries of the page, or of all sequences to filter their content."""
        return self._query(lambda view: self._page(view, selection, after, limit))

    def _page(self, view: View, selection: SequenceFilter, after: str | None, limit: int | None) -> Listing:
        names = [
            name for name in view.entries if selection.match is None or fnmatchcase(name, selection.match)
        ]
        matches: dict[str, SequenceSummary] | None = None
        if selection.metadata or selection.incomplete:
            matches = {one.name: one for one in self._summaries(view, names) if selection.selects(one)}
            names = list(matches)
        rest = [name for name in names if after is None or name > after]
        page = rest[:limit]
        summaries = self._summaries(view, page) if matches is None else [matches[name] for name in page]
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
            self._unmarked.add(encoded(sequence))
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
            for claim in self._claims():
                if claim.name not in live:
                    self._remove_claim(claim)
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
                with suppress(SinkError):  # a claim without a live session is ignored
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
                self._remove_claim(other)

    def _document(self, sequence: str) -> RemotePath:
        return self._root / f"catalog/{encoded(sequence)}{_SUFFIX}"

    def _claim(self, session: str, sequence: str) -> RemotePath:
        return self._root / f"{CLAIMS}/{encoded(sequence)}/{session}"

    def _claims(self) -> list[RemotePath]:
        return [path for path in (self._root / CLAIMS).listing(recursive=True) if path.is_file()]

    def _remove_claim(self, claim: RemotePath) -> None:
        """Remove the claim of a dead writer, which may have written the document but no change."""
        self._mark(claim.parent.name)
        with suppress(FileNotFoundError):
            claim.unlink()

    def _mark(self, key: str) -> None:
        """Write a change of the sequence with this key, after its document."""
        with translate_errors(self._root):
            (self._root / f"{CHANGES}/{new_session_id()}-{key}").write_bytes(b"")
        self._unmarked.discard(key)

    def _name(self, path: RemotePath) -> str:
        name = path.name.removesuffix(_SUFFIX)
        return self._read(path).name if len(name) > _LONGEST_NAME else unquote(name)

    def _query(self, query: Callable[[View], T]) -> T:
        """Return the result of a query over the snapshot and its tail, or over all documents if the snapshot is damaged."""
        try:
            return query(self._view())
        except DamagedSnapshot:
            return query(self._view(use_snapshot=False))

    def _view(self, *, complete: bool = False, use_snapshot: bool = True, may_write: bool = True) -> View:
        """Return where each sequence is found; `complete` lists all documents even if there is a snapshot."""
        # The order of these steps is essential; see the module docstring.
        with translate_errors(self._root):
            claimed = {claim.parent.name for claim in self._claims()}
        changes = list_changes(self._root)
        snapshot = Snapshots.listed(self._root).latest() if use_snapshot else None
        positions = {row.key: position for position, row in enumerate(snapshot.rows if snapshot else ())}
        if snapshot is None or complete:
            documents = self._listed()
            tail = {
                key: path
                for key, path in documents.items()
                if snapshot is None
                or key not in positions
                or not snapshot.rows[positions[key]].is_current(path)
            }
            valid = documents.keys() - tail.keys()
        else:
            keys = claimed.union(map(changed_key, changes))
            tail = {key: self._root / f"catalog/{key}{_SUFFIX}" for key in keys}
            valid = positions.keys() - tail.keys()
        if may_write and max(len(tail), len(changes)) > MAX_TAIL:
            with suppress(SinkError):  # readers may not be allowed to write
                self._bucket.remove(
                    write_snapshot(self._root, self._bucket.now_ns, self._listed, self._contents)
                )
                return self._view(complete=complete, may_write=False)
        entries: dict[str, int | RemotePath | SequenceDocument] = {}
        if snapshot is not None:
            entries.update((snapshot.rows[positions[key]].name, positions[key]) for key in valid)
        if snapshot is None or complete:
            entries.update((self._name(path), path) for path in tail.values())
        else:
            entries.update((one.name, one) for one in self._read_all(list(tail.values())) if one is not None)
        return View(snapshot, dict(sorted(entries.items(), key=itemgetter(0))))

    def _all(self) -> list[SequenceDocument]:
        """Return all documents, sorted by name; complete even if an object of the tail is missing."""

        def read(view: View) -> list[SequenceDocument]:
            return self._documents(view, list(view.entries))

        try:
            return read(self._view(complete=True))
        except DamagedSnapshot:
            return read(self._view(use_snapshot=False))

    def _summaries(self, view: View, names: Sequence[str]) -> list[SequenceSummary]:
        """Return the summaries of the sequences that still exist, in the order of the names."""
        decode = msgspec.json.Decoder(SequenceSummary).decode
        return list(self._values(view, names, SUMMARY, decode, self._summary))

    def _documents(self, view: View, names: Sequence[str]) -> list[SequenceDocument]:
        """Return the documents of the sequences that still exist, in the order of the names."""
        decode = SequenceDocument.model_validate_json
        return list(self._values(view, names, DOCUMENT, decode, lambda document: document))

    def _values(
        self,
        view: View,
        names: Sequence[str],
        column: str,
        decode: Callable[[bytes], T],
        derive: Callable[[SequenceDocument], T],
    ) -> Iterator[T]:
        """Yield a value for each sequence, from the snapshot or its document."""
        entries = {name: view.entries[name] for name in names}
        values: dict[str, T] = {}
        positions = {entry: name for name, entry in entries.items() if isinstance(entry, int)}
        if view.snapshot is not None and positions:
            contents = view.snapshot.read(column, positions.keys())
            values.update((positions[position], decode(content)) for position, content in contents)
        paths = {name: entry for name, entry in entries.items() if isinstance(entry, RemotePath)}
        documents = zip(paths, self._read_all(list(paths.values())), strict=True)
        values.update((name, derive(document)) for name, document in documents if document is not None)
        for name, entry in entries.items():
            if isinstance(entry, SequenceDocument):
                yield derive(entry)
            elif name in values:
                yield values[name]

    def _summary(self, document: SequenceDocument) -> SequenceSummary:
        return SequenceSummary.of(document.info(self._root))

    def _contents(self, paths: Sequence[RemotePath]) -> list[Content | None]:
        """Return the content of each document, None if the document no longer exists."""
        return [
            None
            if document is None
            else Content(
                document.name, msgspec.json.encode(self._summary(document)), _encoded_document(document)
            )
            for document in self._read_all(paths)
        ]

    def _listed(self) -> dict[str, RemotePath]:
        """List all documents by key."""
        with translate_errors(self._root):
            paths = [path for path in (self._root / "catalog").iterdir() if path.is_file()]
        return {path.name.removesuffix(_SUFFIX): path for path in paths if path.suffix == _SUFFIX}

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
        """Write a document; `release` writes the change that names it."""
        self._unmarked.add(encoded(document.name))
        with translate_errors(self._root):
            self._document(document.name).write_bytes(_encoded_document(document))


def _parsed(path: RemotePath) -> SequenceDocument:
    return SequenceDocument.model_validate(json.loads(path.read_bytes()))


def _encoded_document(document: SequenceDocument) -> bytes:
    return json.dumps(document.model_dump(mode="python"), default=str).encode()


def _number(marker: bytes) -> int:
    try:
        return int(json.loads(marker)["format"])
    except (ValueError, KeyError, TypeError) as err:
        raise SinkError(f"{MARKER} does not contain the format of the store", hint="check the URL") from err
