"""This file is the catalog of a store behind a URL: a JSON document for each sequence, replaced as a whole.

Such a store has no transactions, but two things to build on: an object is written whole or not at all, and a listing
shows what was written before it. So a writer first puts its claim on a sequence, then lists the claims: of two writers
at least one sees the other, and gives way. Who holds the claim reads the document, changes it, and writes it.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Collection, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from io import BytesIO
from typing import Any
from urllib.parse import unquote

from pydantic import ValidationError

from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.policies import IfExists
from mosaico_ingest.remote.path import AnyPath, RemotePath
from mosaico_ingest.sink import sequence_exists
from mosaico_ingest.store.bucket import MARKER, Bucket
from mosaico_ingest.store.entries import Claim, NewNote, NewSession, changed
from mosaico_ingest.store.faults import NotInStore, explained
from mosaico_ingest.store.layout import encoded, new_session_id
from mosaico_ingest.store.model import SequenceInfo, TopicInfo
from mosaico_ingest.store.sequence_document import FORMAT, SequenceDocument, check_unchanged

__all__ = ["Documents"]

_SUFFIX = ".json"
_AT_ONCE = 16
_LONGEST_NAME = 200
"""Longer ones are not spelled out in the names of objects."""
_TRIES, _PAUSE_S = 8, 0.25


class Documents:
    """The `Records` of the store in `bucket`; `create` makes it where there is none."""

    def __init__(self, bucket: Bucket, *, create: bool) -> None:
        self._bucket = bucket
        self._root = bucket.root
        marker = self._root / MARKER
        with explained(self._root):
            try:
                found = _number(marker.read_bytes())
            except FileNotFoundError:
                if not create:
                    raise SinkError(
                        "there is no store here", where=str(self._root), hint="check the URL"
                    ) from None
                marker.write_bytes(json.dumps({"format": FORMAT}).encode())
                found = FORMAT
        if found > FORMAT:
            raise SinkError(
                f"the store has format {found}, this version knows up to {FORMAT}",
                where=str(self._root),
                hint="upgrade mosaico-ingest",
            )

    def keep_open(self) -> BytesIO:
        """See `Records.keep_open`; there is nothing to keep."""
        return BytesIO()

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """See `Records.claim`."""
        found = self._load(sequence)
        if found is not None and if_exists in {IfExists.FAIL, IfExists.SKIP}:
            raise sequence_exists(sequence)
        if if_exists is not IfExists.APPEND:
            self._reserve(session, sequence, is_live)
        if found is None:
            return Claim(sequence, if_exists, None, (), {})
        types = found.types if if_exists is IfExists.APPEND else {}
        return Claim(sequence, if_exists, found.created_ns, found.session_ids, types)

    def commit(self, claimed: Claim, new: NewSession) -> list[str]:
        """See `Records.commit`."""
        if claimed.if_exists is IfExists.APPEND:
            with self._holding(claimed.sequence, session=new.id):
                return self._enter(claimed, new)
        with explained(self._root):
            if not self._claim(new.id, claimed.sequence).exists():
                raise changed(claimed.sequence)
        replaced = self._enter(claimed, new)
        with suppress(SinkError):  # what is written counts; a claim without its session is no obstacle
            self.release(new.id, claimed.sequence)
        return replaced

    def release(self, session: str, sequence: str) -> None:
        """See `Records.release`."""
        with explained(self._root), suppress(FileNotFoundError):
            self._claim(session, sequence).unlink()

    def create(self, sequence: str, metadata: str) -> None:
        """See `Records.create`."""
        with self._holding(sequence):
            if self._load(sequence) is not None:
                raise sequence_exists(sequence)
            described = json.loads(metadata)
            self._put(SequenceDocument(name=sequence, metadata=described, created_ns=time.time_ns()))

    def note(self, sequence: str, new: NewNote) -> None:
        """See `Records.note`."""
        with self._holding(sequence):
            self._put(self._known(sequence).with_note(new))

    def names(self) -> list[str]:
        """See `Records.names`."""
        return sorted(self._name(path) for path in self._paths())

    def sequence(self, name: str) -> SequenceInfo | None:
        """See `Records.sequence`."""
        found = self._load(name)
        return None if found is None else found.info(self._root)

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """See `Records.sequences`; each sequence is as it was when it was asked for."""
        return tuple(one.info(self._root) for one in self._all())

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """See `Records.bounds`."""
        found = self._load(topic.sequence)
        segments = [
            segment
            for one in (found.topics if found else ())
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
        """See `Records.delete_sequence`."""
        with self._holding(sequence):
            found = self._known(sequence)
            with explained(self._root):
                self._document(sequence).unlink()
        return found.paths

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """See `Records.delete_topic`."""
        return self._change(sequence, lambda found: found.without_topic(topic))

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """See `Records.delete_session`."""
        return self._change(sequence, lambda found: found.without_session(session))

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """See `Records.delete_notes`."""
        self._change(sequence, lambda found: found.without_notes(topic))

    def forget(self, live: Collection[str]) -> set[str]:
        """See `Records.forget`."""
        with explained(self._root):
            for claim in (self._root / "claims").listing(recursive=True):
                if claim.is_file() and claim.name not in live:
                    with suppress(FileNotFoundError):
                        claim.unlink()
        return {path for one in self._all() for path in one.paths}

    def _enter(self, claimed: Claim, new: NewSession) -> list[str]:
        """Write the document with the session, in which moment it becomes visible; return what it replaces."""
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
        """Replace a document by what `change` makes of it; return the segments it names no longer."""
        with self._holding(sequence):
            found = self._known(sequence)
            left = change(found)
            self._put(left)
        return sorted(set(found.paths) - set(left.paths))

    def _known(self, sequence: str) -> SequenceDocument:
        found = self._load(sequence)
        if found is None:
            raise NotInStore(f"there is no sequence {sequence!r}")
        return found

    @contextmanager
    def _holding(self, sequence: str, *, session: str | None = None) -> Generator[None, None, None]:
        """Hold the claim on a sequence for a moment, waiting for others who do the same."""
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
                time.sleep(_PAUSE_S * (0.5 + random.random()))  # noqa: S311 - so that two do not meet again
            else:
                return

    def _reserve(self, session: str, sequence: str, is_live: Callable[[str], bool]) -> None:
        """Claim a sequence, then look who else does; see the head of this file."""
        own = self._claim(session, sequence)
        with explained(self._root):
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
        with explained(self._root):
            below = (self._root / "catalog").iterdir()
            return [path for path in below if path.is_file() and path.suffix == _SUFFIX]

    def _name(self, path: RemotePath) -> str:
        name = path.name.removesuffix(_SUFFIX)
        return self._read(path).name if len(name) > _LONGEST_NAME else unquote(name)

    def _all(self) -> list[SequenceDocument]:
        with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="catalog") as pool:
            return sorted(pool.map(self._read, self._paths()), key=lambda one: one.name)

    def _load(self, sequence: str) -> SequenceDocument | None:
        try:
            return self._read(self._document(sequence))
        except NotInStore:
            return None

    def _read(self, path: RemotePath) -> SequenceDocument:
        with explained(path):
            try:
                return SequenceDocument.model_validate(json.loads(path.read_bytes()))
            except FileNotFoundError as err:
                raise NotInStore("it is not in the catalog", where=str(path)) from err
            except (ValueError, ValidationError) as err:
                problem = str(err).splitlines()[0]
                raise SinkError(f"the document cannot be read: {problem}", where=str(path)) from err

    def _put(self, document: SequenceDocument) -> None:
        content = json.dumps(document.model_dump(mode="python"), default=str).encode()
        with explained(self._root):
            self._document(document.name).write_bytes(content)


def _number(marker: bytes) -> int:
    try:
        return int(json.loads(marker)["format"])
    except (ValueError, KeyError, TypeError) as err:
        raise SinkError(f"{MARKER} does not say what format the store has", hint="check the URL") from err
