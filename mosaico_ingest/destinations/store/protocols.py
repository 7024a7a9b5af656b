"""The interfaces of a store's parts: `Files` holds the segments, `StoreCatalog` records which of them are committed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from mosaico_ingest.destinations.base import FamilyTopic
from mosaico_ingest.destinations.store.listing import Listing, SequenceFilter
from mosaico_ingest.destinations.store.model import (
    Claim,
    NewNote,
    NewSession,
    Replacement,
    SequenceInfo,
    TopicInfo,
)
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.remote import AnyPath


class Lease(Protocol):
    """Shows other processes that a writer is alive."""

    def release(self) -> None:
        """Release the lease; a second call has no effect."""
        ...


class Closable(Protocol):
    """An object that can be closed."""

    def close(self) -> None:
        """Close it."""
        ...


class Files(Protocol):
    """The files of a store: `LocalFiles` on a disk, `ObjectFiles` behind a URL."""

    @property
    def root(self) -> AnyPath:
        """The folder of the store."""
        ...

    def topic(self, sequence: str, topic: str) -> AnyPath:
        """Return the folder of a topic's segments."""
        ...

    def staged(self, session: str, sequence: str, topic: str, number: int) -> AnyPath:
        """Return the path at which a session writes a segment before the commit."""
        ...

    def attachment(self, sequence: str, name: str) -> AnyPath:
        """Return the path of an attachment after the commit."""
        ...

    def staged_attachment(self, session: str, sequence: str, name: str) -> AnyPath:
        """Return the path at which a session writes an attachment before the commit."""
        ...

    def relative(self, path: AnyPath) -> str:
        """Return a segment's path relative to the store, as in the catalog."""
        ...

    def begin(self, session: str) -> Lease:
        """Prepare a session and return the lease that shows that its writer is alive."""
        ...

    def is_live(self, session: str) -> bool:
        """Return whether the session's writer is alive."""
        ...

    def in_use(self, session: str, grace_s: float) -> bool:
        """Return whether the session's writer is alive or may be about to start."""
        ...

    def sync(self, paths: Sequence[AnyPath]) -> None:
        """Wait until closed files are on the disk."""
        ...

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Move synced files to their final paths, so that they survive a power cut; files that were moved are skipped."""
        ...

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments; garbage collection retries failed removals."""
        ...

    def discard(self, session: str) -> None:
        """Remove the staged files of a session."""
        ...

    def open_sessions(self) -> list[str]:
        """Return the sessions that were started and not ended, alive or not."""
        ...

    def staged_files(self, session: str) -> list[AnyPath]:
        """Return the segments that a session started and did not publish."""
        ...

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folder of segments."""
        ...


class StoreCatalog(Protocol):
    """The catalog of a store: `Catalog` in SQLite, `ObjectCatalog` as JSON documents behind a URL.

    Every change is atomic. Methods that remove entries return the paths of segments that are no longer needed.
    """

    def keep_open(self) -> Closable:
        """Return a handle that keeps the catalog open, which makes calls cheaper until it is closed."""
        ...

    def claim(
        self, session: str, sequence: str, if_exists: IfExists, *, is_live: Callable[[str], bool]
    ) -> Claim:
        """Claim a sequence for a session.

        Raises:
            SequenceExists: The sequence exists and `if_exists` forbids it, or another session writes it.
        """
        ...

    def commit(self, sessions: Sequence[tuple[Claim, NewSession]]) -> list[str]:
        """Add sessions and return the paths of the segments they replace.

        A catalog with transactions adds all of them, or none if one cannot be added. Others commit one session at a time.
        """
        ...

    def replace_segments(self, change: Replacement) -> bool:
        """Enter a merged segment in place of others; False if one of them is not in the catalog any more."""
        ...

    def release(self, session: str, sequence: str) -> None:
        """Release the claim of a session."""
        ...

    def create(self, sequence: str, metadata: str) -> None:
        """Add a sequence without a session."""
        ...

    def note(self, sequence: str, new: NewNote) -> None:
        """Attach a note to an existing sequence."""
        ...

    def names(self) -> list[str]:
        """Return the sorted names of all sequences."""
        ...

    def sequence(self, name: str) -> SequenceInfo | None:
        """Return a sequence, or None."""
        ...

    def headers(self, names: Collection[str]) -> tuple[SequenceInfo, ...]:
        """Return the sequences with these names, without their topics, in any order."""
        ...

    def sequences(self) -> tuple[SequenceInfo, ...]:
        """Return every sequence by name, in one consistent state if the catalog supports it."""
        ...

    def listing(self, selection: SequenceFilter, *, after: str | None, limit: int | None) -> Listing:
        """Return the selected sequences after the name `after`, at most `limit`, sorted by name."""
        ...

    def family_topics(self, family: str | None, names: Collection[str]) -> tuple[FamilyTopic, ...]:
        """Return the topics with these names that sessions of the family created, oldest session first."""
        ...

    def bounds(self, topic: TopicInfo, columns: Collection[str]) -> dict[AnyPath, dict[str, tuple[Any, Any]]]:
        """Return the bounds of columns by segment path."""
        ...

    def delete_sequence(self, sequence: str) -> list[str]:
        """Remove a sequence; raises NotInStore if it does not exist."""
        ...

    def delete_topic(self, sequence: str, topic: str) -> list[str]:
        """Remove a topic; raises NotInStore if it does not exist."""
        ...

    def delete_session(self, sequence: str, session: str) -> list[str]:
        """Remove everything a session added; raises NotInStore if it does not exist."""
        ...

    def delete_notes(self, sequence: str, topic: str | None) -> None:
        """Remove the notes of a sequence itself, or of one of its topics."""
        ...

    def forget(self, live: Collection[str]) -> set[str]:
        """Remove the claims of sessions that are not alive and return the paths of all segments."""
        ...
