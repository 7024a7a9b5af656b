"""This file is where things lie in a store, and how they get there to stay.

    catalog.sqlite
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    staging/<session>/                       what an open session has written so far, and its lock

A part of a name keeps its letters, digits, `_` and `-`; every other byte becomes `%XX`, so no name leads
out of its folder, and a part too long for a file system ends in a hash.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.lease import Lease, is_live

__all__ = ["Layout", "encoded", "fsync", "new_session_id"]

_UNSAFE = re.compile(rb"[^A-Za-z0-9_-]")
_LONGEST = 200
_ATTEMPTS = 5
_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


@frozen
class Layout:
    """The paths of the store at `root`."""

    root: Path

    @property
    def catalog(self) -> Path:
        """The SQLite file."""
        return self.root / "catalog.sqlite"

    @property
    def segments(self) -> Path:
        """The folder of committed Parquet files."""
        return self.root / "segments"

    @property
    def staging(self) -> Path:
        """The folder of open sessions."""
        return self.root / "staging"

    def session(self, session: str) -> Path:
        """Return the folder an open session writes to."""
        return self.staging / session

    def lock(self, session: str) -> Path:
        """Return the file an open session keeps locked."""
        return self.session(session) / "lock"

    def topic(self, sequence: str, topic: str) -> Path:
        """Return the folder of a topic's segments."""
        parts = (sequence, *topic.strip("/").split("/"))
        return Path(self.root, "segments", *map(encoded, parts))

    def staged(self, session: str, sequence: str, topic: str, number: int) -> Path:  # noqa: ARG002 - it is moved later
        """Return where a session writes a segment before it is published."""
        return Path(self.root, "staging", session, f"{session}-{number:04}.parquet")

    def relative(self, path: AnyPath) -> str:
        """Return how the catalog spells a segment's path."""
        return Path(str(path)).relative_to(self.root).as_posix()

    def begin(self, session: str) -> Lease:
        """Make a session's folder, and lock it for as long as its writer lives."""
        with explained(self.staging):
            self.session(session).mkdir(parents=True)
            return Lease(self.lock(session))

    def is_live(self, session: str) -> bool:
        """Say whether a process holds the session's lock."""
        return is_live(self.lock(session))

    def in_use(self, session: str, grace_s: float) -> bool:
        """Say whether the session's lock is held, or its folder so young that it may be about to be."""
        folder = self.session(session)
        young = folder.exists() and time.time() - folder.stat().st_mtime < grace_s
        return young or self.is_live(session)

    def open_sessions(self) -> list[str]:
        """Return the sessions that have a staging folder, live or not."""
        return sorted(entry.name for entry in self.staging.iterdir()) if self.staging.is_dir() else []

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folder of segments."""
        for folder, _, files in os.walk(self.segments):
            yield from (Path(folder, name) for name in files)

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Move finished files to their places, so that they are still there after a power cut."""
        changed: set[Path] = set()
        for staged, target in ((Path(str(old)), Path(str(new))) for old, new in moves.items()):
            changed.add(target.parent)
            changed.update(folder.parent for folder in takewhile(_is_missing, target.parents))
            _move(staged, target)
        for folder in changed:
            fsync(folder)

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segment files and the folders that are empty then; garbage collection gets what resists."""
        for path in (Path(str(one)) for one in paths):
            with suppress(OSError):
                path.unlink()
            with suppress(OSError):
                self._prune(path.parent)

    def _prune(self, folder: Path) -> None:
        while folder != self.segments:
            folder.rmdir()
            folder = folder.parent

    def staged_files(self, session: str) -> list[AnyPath]:
        """Return the segments a session has begun and not published."""
        return [path for path in self.session(session).rglob("*.parquet") if path.is_file()]

    def discard(self, session: str) -> None:
        """Remove what a session has staged."""
        shutil.rmtree(self.session(session), ignore_errors=True)


def encoded(part: str) -> str:
    """Return a part of a name as a part of a path, as the head of this file says."""
    safe = _UNSAFE.sub(lambda match: b"%%%02X" % match.group()[0], part.encode()).decode()
    if len(safe) <= _LONGEST:
        return safe
    return f"{safe[:_LONGEST]}%{hashlib.sha256(part.encode()).hexdigest()[:16]}"


def _is_missing(folder: Path) -> bool:
    return not folder.exists()


def _move(staged: Path, target: Path) -> None:
    for attempts_left in reversed(range(_ATTEMPTS)):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            staged.rename(target)
        except FileNotFoundError:  # a deletion next door may remove the empty folder just made
            if not attempts_left or not staged.exists():
                raise
        else:
            return


def fsync(path: Path) -> None:
    """Wait until the file's or folder's content is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def new_session_id() -> str:
    """Return a ULID: 48 bits of milliseconds, 80 random bits, in 26 characters that sort by time."""
    number = (time.time_ns() // 1_000_000) << 80 | secrets.randbits(80)
    return "".join(_CROCKFORD[number >> shift & 31] for shift in range(125, -1, -5))
