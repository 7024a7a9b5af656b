"""This file is the seams of a store: `Files` hold the rows, `Records` say which of them count."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, Protocol

from mosaico_ingest.destinations.store.catalog import Claim, NewNote, NewSession
from mosaico_ingest.destinations.store.model import SequenceInfo, TopicInfo
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.remote import AnyPath

__all__ = ["Closable", "Files", "Lease", "Records"]


class Lease(Protocol):
    """Shows that a writer lives."""

    def release(self) -> None:
        """Release it; releasing twice does no harm."""
        ...


class Closable(Protocol):
    """What can be closed."""

    def close(self) -> None:
        """Close it."""
        ...


class Files(Protocol):
    """Where segments lie: `layout.Layout` on a disk, `bucket.Bucket` behind a URL."""

    @property
    def root(self) -> AnyPath:
        """The folder of the store."""
        ...

    def topic(self, sequence: str, topic: str) -> AnyPath:
        """Return the folder of a topic's segments."""
        ...

    def staged(self, session: str, sequence: str, topic: str, number: int) -> AnyPath:
        """Return where a session writes a segment before it is published."""
        ...

    def relative(self, path: AnyPath) -> str:
        """Return how the records spell a segment's path."""
        ...

    def begin(self, session: str) -> Lease:
        """Make room for a session, and show that it lives until the lease is released."""
        ...

    def is_live(self, session: str) -> bool:
        """Say whether the session's writer lives."""
        ...

    def in_use(self, session: str, grace_s: float) -> bool:
        """Say whether the session's writer lives, or may be about to begin."""
        ...

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Move finished files to their places, so that they are there to stay."""
        ...

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments; garbage collection gets what resists."""
        ...

    def discard(self, session: str) -> None:
        """Remove what a session has staged."""
        ...

    def open_sessions(self) -> list[str]:
        """Return the sessions that have begun and not ended, live or not."""
        ...

    def staged_files(self, session: str) -> list[AnyPath]:
        """Return the segments a session has begun and not published."""
        ...

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folder of segments."""
        ...


class Records(Protocol):
    """What a store knows: `catalog.Catalog` in SQLite, `documents.Documents` as JSON behind a URL.

    Each change happens as a whole or not at all; methods that remove return the paths nobody needs then.
    """

    def keep_open(self) -> Closable:
        """Make what follows cheaper until the answer is closed."""
        ...

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """Note that a session will write a sequence, or refuse because it must not or another does."""
        ...

    def commit(self, claimed: Claim, new: NewSession) -> list[str]:
        """Enter a session and return the paths of the segments it replaces."""
        ...

    def release(self, session: str, sequence: str) -> None:
        """Give the name back."""
        ...

    def create(self, sequence: str, metadata: str) -> None:
        """Enter a sequence without a session."""
        ...

    def note(self, sequence: str, new: NewNote) -> None:
        """Attach a note to a sequence that is there."""
        ...

    def names(self) -> list[str]:
        """Return the names of all sequences, sorted."""
        ...

    def sequence(self, name: str) -> SequenceInfo | None:
        """Return all that is known of a sequence, None where there is none."""
        ...

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence, by name, as they were at one moment where that can be had."""
        ...

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """Return the known bounds of columns, by the path of the segment."""
        ...

    def delete_sequence(self, sequence: str) -> list[str]:
        """Remove a sequence; NotInStore where there is none."""
        ...

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """Remove a topic; NotInStore where there is none."""
        ...

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """Remove what a session added; NotInStore where there is none."""
        ...

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """Remove the notes of a sequence itself, or those of one of its topics."""
        ...

    def forget(self, live: Collection[str]) -> set[str]:
        """Drop the claims of sessions that are not live and return the paths of all segments."""
        ...
