"""This file is a writing session of the store: what it wrote appears in one transaction, or not at all."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

from mosaico_ingest import wire
from mosaico_ingest.errors import IngestError, SinkError
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.policies import IfExists
from mosaico_ingest.remote.path import RemotePath
from mosaico_ingest.sink import StoredTopic, check_same_type
from mosaico_ingest.store import entries, files
from mosaico_ingest.store.content import combined
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.layout import new_session_id
from mosaico_ingest.store.seams import Files, Records
from mosaico_ingest.store.segment import time_span
from mosaico_ingest.store.topic import Staging, StoreTopic

__all__ = ["StoreSession"]

_WORTH_A_THREAD_BYTES = 1 << 18
"""A topic that holds less is written sooner than handed over, unless it goes behind a URL."""
_FAST_S = 0.005
_AT_ONCE = 8
_WAITING = 2
"""How many threads may wait for the disk while others encode."""


class StoreSession:
    """One writing session; `commit` or `discard` ends it."""

    def __init__(
        self,
        layout: Files,
        catalog: Records,
        sequence: str,
        metadata: str,
        *,
        if_exists: IfExists,
        buffer_bytes: int,
    ) -> None:
        self.id = new_session_id()
        self.created_ns = time.time_ns()
        self._layout = layout
        self._catalog = catalog
        self._metadata = metadata
        self._given: dict[str, StoreTopic] = {}
        self._notes: list[entries.NewNote] = []
        self._staging = Staging(
            layout.root, partial(layout.staged, self.id, sequence), buffer_bytes=buffer_bytes
        )
        self._lease = layout.begin(self.id)
        self._held = ExitStack()
        try:
            self._held.enter_context(closing(catalog.keep_open()))
            self._claim = catalog.claim(self.id, sequence, if_exists, is_live=layout.is_live)
        except BaseException:
            self._leave()
            raise

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> StoreTopic:
        """Open a topic; see `Session.topic`."""
        path = wire.check_topic_name(name)
        described = wire.check_metadata(metadata, where=name)
        if path in self._staging.topics:
            raise SinkError("the topic is open already", where=name)
        held = self._claim.types.get(path)
        if held is not None:
            check_same_type(held, ontology, where=name)
        with explained(name):
            folder = self._layout.topic(self._claim.sequence, path)
            topic = StoreTopic(self._staging, path, ontology, described, folder=folder)
        self._staging.topics[path] = self._given[name] = topic
        return topic

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error; see `Session.note_error`."""
        path = None if topic is None else wire.check_topic_name(topic)
        self._notes.append(entries.NewNote(path, message, time.time_ns()))

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return what the footers of the committed files say; see `Session.stored`."""
        return tuple(self._stored(name, topic) for name, topic in self._given.items())

    def commit(self) -> None:
        """Finish every topic, move the segments to their places, and enter them in the catalog at once."""
        self._close_topics()
        moves = {
            segment.path: topic.folder / segment.path.name
            for topic in self._staging.topics.values()
            for segment in topic.segments
        }
        topics = tuple(map(self._placed, self._staging.topics.values()))
        new = entries.NewSession(self.id, self._metadata, self.created_ns, topics, tuple(self._notes))
        try:
            with explained(self._layout.root):
                self._layout.publish(moves)
            replaced = self._catalog.commit(self._claim, new)
        except BaseException:
            if not self._may_be_entered():
                self._layout.remove(moves.values())
            raise
        self._leave()
        self._layout.remove(self._layout.root / path for path in replaced)

    def _close_topics(self) -> None:
        """Close large topics on threads, and small ones here meanwhile."""
        # the largest first, so that no thread is left with it at the end
        waiting = sorted(self._staging.topics.values(), key=lambda topic: -topic.buffered_bytes)
        most = 0 if isinstance(self._layout.root, RemotePath) else _WORTH_A_THREAD_BYTES
        large = [topic for topic in waiting if topic.buffered_bytes >= most]
        small = waiting[len(large) :]
        with ThreadPoolExecutor((os.cpu_count() or 1) + _WAITING, thread_name_prefix="segment") as pool:
            closing_large = pool.map(_close_and_settle, large)
            for topic in small:
                topic.close()
            _settle(small)
            list(closing_large)

    def discard(self) -> None:
        """Leave no trace."""
        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="segment") as pool:
            list(pool.map(StoreTopic.abandon, self._staging.topics.values()))
        try:
            self._catalog.release(self.id, self._claim.sequence)
        except SinkError:
            return  # the error that ended the session matters more, and the name is free without its lock
        finally:
            self._leave()

    def _may_be_entered(self) -> bool:
        """Say whether the catalog has the session although its commit failed, as its answer may be lost.

        Where it cannot be read it may have: files that nobody needs go with the garbage, lost ones do not come back.
        """
        try:
            info = self._catalog.sequence(self._claim.sequence)
        except IngestError:
            return True
        return info is not None and any(session.id == self.id for session in info.sessions)

    def _placed(self, topic: StoreTopic) -> entries.NewTopic:
        relative = self._layout.relative(topic.folder)
        segments = {f"{relative}/{segment.path.name}": segment for segment in topic.segments}
        return entries.NewTopic(
            topic.name, topic.ontology, topic.schema, topic.metadata, topic.created_ns, segments
        )

    def _stored(self, name: str, topic: StoreTopic) -> StoredTopic:
        rows = stored_bytes = 0
        times: list[int] = []
        for segment in topic.segments:
            path = topic.folder / segment.path.name
            with explained(path):
                footer = files.footer(path)
                stored_bytes += path.stat().st_size
                rows += footer.num_rows
                for group in range(footer.num_row_groups):
                    times += time_span(footer, group)
        checksum = combined(s.checksum for s in sorted(topic.segments, key=lambda s: (s.start_ns, s.path)))
        return StoredTopic(
            name, rows, min(times, default=None), max(times, default=None), stored_bytes, checksum
        )

    def _leave(self) -> None:
        self._held.close()
        self._lease.release()
        self._layout.discard(self.id)


def _close_and_settle(topic: StoreTopic) -> None:
    topic.close()
    topic.settle()


def _settle(topics: Sequence[StoreTopic]) -> None:
    """Wait for the disk one topic after the other where it is fast, for several at once where it turns out not to be."""
    began = time.monotonic()
    for done, topic in enumerate(topics):
        if time.monotonic() - began > _FAST_S:
            with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="fsync") as pool:
                list(pool.map(StoreTopic.settle, topics[done:]))
            return
        topic.settle()
