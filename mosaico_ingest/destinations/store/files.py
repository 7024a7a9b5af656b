"""Files of a store: paths, publication, writer leases, on a disk or behind a URL.

SQLite takes the lock, because it does so on every platform, also between threads of one process, and
without passing it on to a forked child.

catalog.sqlite
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    staging/<session>/                       what an open session has written so far, and its lock

A part of a name keeps its letters, digits, `_` and `-`; every other byte becomes `%XX`, so no name leads
out of its folder, and a part too long for a file system ends in a hash.

store.json                               that there is a store, and its format
    catalog/<sequence>.json                  all that is known of a sequence
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    claims/<sequence>/<session>              who is writing a sequence
    sessions/<session>                       that a writer lives: written again and again while it does

Nothing can be renamed there, so segments are written in their places; only those a catalog entry names count.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import shutil
import sqlite3
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct

from mosaico_ingest.destinations.store.errors import explained
from mosaico_ingest.errors import IngestError, SinkUnavailable
from mosaico_ingest.remote import AnyPath, RemotePath

__all__ = [
    "MARKER",
    "Bucket",
    "Heartbeat",
    "Layout",
    "Lease",
    "create",
    "encoded",
    "footer",
    "fsync",
    "is_live",
    "new_session_id",
    "opened",
    "send_ahead",
    "settle",
]


class Lease:
    """An exclusive lock on the file at `path`, held until `release` or the end of the process."""

    def __init__(self, path: Path) -> None:
        self._db = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
        try:
            self._db.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error:
            self._db.close()
            raise

    def release(self) -> None:
        """Release the lock."""
        self._db.close()


def is_live(path: Path) -> bool:
    """Return whether a process holds the lock at `path`."""
    if not path.is_file():
        return False
    try:
        Lease(path).release()
    except sqlite3.OperationalError as err:
        return "locked" in str(err)
    return False


def create(path: AnyPath) -> pa.NativeFile:
    """Open a new file for writing; behind a URL it is sent while it is written, and there once it is closed."""
    return path.open_output() if isinstance(path, RemotePath) else pa.OSFile(str(path), "wb")


def send_ahead(file: pa.NativeFile, begin: int, end: int) -> None:
    """Have the system begin to bring a stretch of a file to the disk, so that `settle` waits for less; on Linux it does."""
    if isinstance(file, pa.OSFile) and hasattr(os, "posix_fadvise"):
        # Linux writes dirty pages when it is told that they are not needed, without anyone waiting for it. It is a
        # hint: a file system that takes none is no reason to stop, and a disk that fails says so to `settle`.
        with suppress(OSError):
            os.posix_fadvise(file.fileno(), begin, end - begin, os.POSIX_FADV_DONTNEED)


def settle(path: AnyPath) -> None:
    """Wait until a closed file is there to stay; a store behind a URL has said so already."""
    if not isinstance(path, RemotePath):
        fsync(path)


def opened(path: AnyPath, **options: Any) -> pq.ParquetFile:  # noqa: ANN401 - those of `pq.ParquetFile`
    """Open a Parquet file for reading; behind a URL the column chunks of a row group are asked for together."""
    if isinstance(path, RemotePath):
        return pq.ParquetFile(path.open_input(), pre_buffer=True, **options)
    return pq.ParquetFile(path, **options)


def footer(path: AnyPath) -> pq.FileMetaData:
    """Return what a Parquet file says of itself."""
    with opened(path) as file:
        return file.metadata


_UNSAFE = re.compile(rb"[^A-Za-z0-9_-]")
_LONGEST = 200
_ATTEMPTS = 5
_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


class Layout(Struct, frozen=True):
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


MARKER = "store.json"

_BEAT_S = 20.0
_SILENT_S = 180.0
"""A writer that has not been heard of for so long counts as dead."""
_LAST_BEAT_S = 5.0
"""How long the end of a session waits for a beat under way."""
_AT_ONCE = 8


class Bucket:
    """The `Files` of a store at `root`."""

    def __init__(self, root: RemotePath) -> None:
        self.root = root
        self._begun: defaultdict[str, list[RemotePath]] = defaultdict(list)
        self._beats: dict[str, Heartbeat] = {}

    def is_there(self) -> bool:
        """Say whether there is a store."""
        with explained(self.root):
            return (self.root / MARKER).is_file()

    def topic(self, sequence: str, topic: str) -> RemotePath:
        """Return the folder of a topic's segments."""
        parts = (sequence, *topic.strip("/").split("/"))
        return self.root / "/".join(("segments", *(encoded(part) for part in parts)))

    def staged(self, session: str, sequence: str, topic: str, number: int) -> RemotePath:
        """Return where a segment is written: in its place, and not in the catalog yet."""
        path = self.topic(sequence, topic) / f"{session}-{number:04}.parquet"
        self._begun[session].append(path)
        return path

    def relative(self, path: AnyPath) -> str:
        """Return how the catalog spells a segment's path."""
        return str(path).removeprefix(f"{self.root}/")

    def begin(self, session: str) -> Heartbeat:
        """Show that a session's writer lives until the lease is released."""
        with explained(self.root):
            beat = self._beats[session] = Heartbeat(self._session(session))
        return beat

    def is_live(self, session: str) -> bool:
        """Say whether the session's writer was heard of lately, by the clock of the store."""
        with explained(self.root):
            try:
                heard_ns = self._session(session).stat().st_mtime_ns
            except FileNotFoundError:
                return False
            return self._now_ns() - heard_ns < _SILENT_S * 1e9

    def in_use(self, session: str, grace_s: float) -> bool:  # noqa: ARG002 - a session is heard of before it writes
        """Say whether the session's writer lives."""
        return self.is_live(session)

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Forget finished files, which are in their places already."""
        for session, begun in list(self._begun.items()):
            if any(path in moves for path in begun):
                self._beats[session].check()
                begun[:] = [path for path in begun if path not in moves]

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments; garbage collection gets what resists."""
        with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="remove") as pool:
            list(pool.map(_remove, paths))

    def discard(self, session: str) -> None:
        """Remove what a session has begun and not published; where the store does not answer, that is left to garbage collection."""
        begun = self._begun.pop(session, [])
        self._beats.pop(session, None)
        try:
            self._session(session).unlink()
        except (
            FileNotFoundError
        ):  # garbage collection removed it; files written since are still to be removed
            pass
        except (IngestError, OSError):
            return
        self.remove(begun)

    def open_sessions(self) -> list[str]:
        """Return the sessions that have begun and not ended, live or not."""
        return [path.name for path in (self.root / "sessions").iterdir() if path.is_file()]

    def staged_files(self, session: str) -> list[AnyPath]:  # noqa: ARG002 - `Files` asks it of all
        """Return nothing: what is not in the catalog is among the files of segments."""
        return []

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folder of segments."""
        below = (self.root / "segments").listing(recursive=True)
        return (path for path in below if path.is_file())

    def _session(self, session: str) -> RemotePath:
        return self.root / f"sessions/{session}"

    def _now_ns(self) -> int:
        """Return the time by the clock that all writers share: that of the store."""
        clock = self.root / "clock"
        clock.write_bytes(b"")
        return clock.stat().st_mtime_ns


class Heartbeat:
    """Writes an object again and again, until it is released or the process ends."""

    def __init__(self, path: RemotePath) -> None:
        self._path = path
        self._stop = threading.Event()
        self._path.write_bytes(b"")
        self._heard_s = time.monotonic()
        self._thread = threading.Thread(target=self._beat, name="mosaico-heartbeat", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise where others may think that this writer is dead, and may have removed its files."""
        if time.monotonic() - self._heard_s > _SILENT_S:
            raise SinkUnavailable(
                f"the store could not be told for {_SILENT_S:.0f} s that this session lives",
                where=str(self._path),
                hint="run again",
            )

    def release(self) -> None:
        """Stop; twice does no harm."""
        self._stop.set()
        self._thread.join(_LAST_BEAT_S)

    def _beat(self) -> None:
        while not self._stop.wait(_BEAT_S):
            begun_s = time.monotonic()
            with suppress(IngestError, OSError):  # the next beat may come through
                self._path.write_bytes(b"")
                self._heard_s = begun_s


def _remove(path: AnyPath) -> None:
    with suppress(IngestError, OSError):
        path.unlink()
