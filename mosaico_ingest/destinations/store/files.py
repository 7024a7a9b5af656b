"""The files of a store: paths, publication, writer leases and errors, on a disk or behind a URL.

On a disk:

    catalog.sqlite
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    attachments/<sequence>/<session>-<number>-<name>
    staging/<session>/                       the unpublished segments of an open session, and its lock

Behind a URL:

    store.json                               the format of the store
    catalog/<sequence>.json                  the catalog entry of a sequence
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    attachments/<sequence>/<session>-<number>-<name>
    claims/<sequence>/<session>              the claim of a session on a sequence
    sessions/<session>                       rewritten regularly while the session's writer is alive
    changes/<id>-<sequence>                  names a sequence that was changed, until a snapshot contains the change
    snapshots/<number>-<id>/                 copies of the catalog entries, see `documents`

Objects cannot be renamed, so segments are written at their final paths; only segments in a catalog entry are valid.

A path component keeps letters, digits, `_` and `-` of a name. Every other byte becomes `%XX`, so that no name leads out
of its folder, and a component that is too long for a file system ends in a hash.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import shutil
import sqlite3
import threading
import time
from collections import defaultdict
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from typing import Any, cast

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct

from mosaico_ingest.errors import IngestError, SinkError, SinkUnavailable, Unreachable
from mosaico_ingest.remote import AnyPath, RemotePath, as_ingest_error, is_transient

_HINTS = {
    errno.ENOSPC: "free some space, or choose another target.store",
    errno.EDQUOT: "free some quota, or choose another target.store",
    errno.EROFS: "choose a target.store that you can write to",
    errno.EACCES: "choose a target.store that you can write to",
    errno.EPERM: "choose a target.store that you can write to",
    errno.EEXIST: "remove the file at this path, or choose another target.store",
    errno.ENOTDIR: "remove the file at this path, or choose another target.store",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENOENT: "check whether another program changes the store, then run again",
}


class NotInStore(SinkError):  # noqa: N818 - the condition, as in `errors`
    """The store has no sequence, topic or session of this name."""


def sequence_changed(sequence: str) -> SinkError:
    """Return the error for a sequence that changed after the session started."""
    return SinkError("another run changed the sequence meanwhile", where=sequence, hint="run again")


@contextmanager
def translate_errors(where: AnyPath | str) -> Generator[None, None, None]:
    """Raise SinkError, with the location and a hint, for errors of the disk, SQLite or Arrow inside."""
    try:
        yield
    except Unreachable as err:
        raise SinkUnavailable(err.what, where=err.where, hint=err.hint) from err
    except OSError as err:
        if is_transient(err):
            cause = as_ingest_error(err, str(where))
            raise SinkUnavailable(cause.what, where=cause.where, hint=cause.hint) from err
        code = err.errno or 0
        what = os.strerror(code) if code else _first_line(err)
        raise SinkError(what, where=str(err.filename or where), hint=_HINTS.get(code)) from err
    except pa.ArrowException as err:
        raise SinkError(_first_line(err), where=str(where)) from err
    except sqlite3.OperationalError as err:
        raise _sqlite_error(err, str(where)) from err
    except sqlite3.Error as err:
        raise SinkError(f"the catalog cannot be used: {_first_line(err)}", where=str(where)) from err


def _sqlite_error(err: sqlite3.OperationalError, where: str) -> SinkError:
    text = str(err)
    if "locked" in text:
        return SinkUnavailable("the catalog is busy with another process", where=where, hint="try again")
    if "full" in text:
        return SinkError("no space left on the device", where=where, hint=_HINTS[errno.ENOSPC])
    if "readonly" in text or "unable to open" in text:
        return SinkError(f"the catalog cannot be written: {text}", where=where, hint=_HINTS[errno.EROFS])
    return SinkError(f"the catalog cannot be used: {text}", where=where)


def _first_line(err: BaseException) -> str:
    return (str(err).strip() or type(err).__name__).splitlines()[0]


class Lease:
    """An exclusive lock on the file at `path`, held until `release` or the end of the process.

    SQLite's lock works on every platform and between threads of one process, and a forked child does not inherit it.
    """

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
    """Open a new file for writing; a file behind a URL exists once it is closed."""
    return path.open_output() if isinstance(path, RemotePath) else pa.OSFile(str(path), "wb")


def send_ahead(file: pa.NativeFile, start: int, end: int) -> None:
    """Ask the system to start writing a range of a file to the disk, so that `sync` waits for less; has an effect on Linux."""
    if isinstance(file, pa.OSFile) and hasattr(os, "posix_fadvise"):
        # Linux starts writing dirty pages that are not needed, without blocking. This is a hint, so errors are
        # ignored; `sync` reports errors of the disk.
        with suppress(OSError):
            os.posix_fadvise(file.fileno(), start, end - start, os.POSIX_FADV_DONTNEED)


def sync(path: AnyPath) -> None:
    """Wait until a closed file is on the disk; a closed file behind a URL is already stored."""
    if not isinstance(path, RemotePath):
        fsync(path)


def opened(path: AnyPath, **options: Any) -> pq.ParquetFile:  # noqa: ANN401 - those of `pq.ParquetFile`
    """Open a Parquet file for reading; behind a URL, the column chunks of a row group are requested together."""
    if isinstance(path, RemotePath):
        return pq.ParquetFile(path.open_input(), pre_buffer=True, **options)
    return pq.ParquetFile(path, **options)


def footer(path: AnyPath) -> pq.FileMetaData:
    """Return the footer of a Parquet file."""
    with opened(path) as file:
        return file.metadata


ATTACHMENTS = "attachments"
"""The folder of the files of sequences."""
_UNSAFE = re.compile(rb"[^A-Za-z0-9_-]")
_LONGEST = 200
_ATTEMPTS = 5
_FAST_S = 0.005
"""Seconds of waiting for the disk after which several threads wait."""
_THREADS = 8
"""Number of threads that wait for the disk or for requests."""
_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


class LocalFiles(Struct, frozen=True):
    """The files of the store in the folder `root`; see `Files`."""

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

    def staged(self, session: str, sequence: str, topic: str, number: int) -> Path:  # noqa: ARG002 - the file is moved later
        """Return where a session writes a segment before it is published."""
        return Path(self.root, "staging", session, f"{session}-{number:04}.parquet")

    def attachment(self, sequence: str, name: str) -> Path:
        """Return the path of an attachment after the commit."""
        return Path(self.root, ATTACHMENTS, encoded(sequence), name)

    def staged_attachment(self, session: str, sequence: str, name: str) -> Path:  # noqa: ARG002 - the file is moved later
        """Return where a session writes an attachment before it is published."""
        return self.session(session) / name

    def relative(self, path: AnyPath) -> str:
        """Return a segment's path relative to the store, as in the catalog."""
        return Path(str(path)).relative_to(self.root).as_posix()

    def begin(self, session: str) -> Lease:
        """Create a session's folder and lock it while its writer is alive."""
        with translate_errors(self.staging):
            self.session(session).mkdir(parents=True)
            return Lease(self.lock(session))

    def is_live(self, session: str) -> bool:
        """Return whether a process holds the session's lock."""
        return is_live(self.lock(session))

    def in_use(self, session: str, grace_s: float) -> bool:
        """Return whether the session's lock is held, or its folder is so new that it may be locked soon."""
        folder = self.session(session)
        young = folder.exists() and time.time() - folder.stat().st_mtime < grace_s
        return young or self.is_live(session)

    def open_sessions(self) -> list[str]:
        """Return the sessions with a staging folder, alive or not."""
        return sorted(entry.name for entry in self.staging.iterdir()) if self.staging.is_dir() else []

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folders of segments and attachments."""
        for top in (self.segments, self.root / ATTACHMENTS):
            for folder, _, files in os.walk(top):
                yield from (Path(folder, name) for name in files)

    def sync(self, paths: Sequence[AnyPath]) -> None:
        """Wait until files or folders are on the disk: on this thread, and on several once the disk turns out to be slow."""
        start_s = time.monotonic()
        for done, path in enumerate(paths):
            if time.monotonic() - start_s > _FAST_S:
                with ThreadPoolExecutor(_THREADS, thread_name_prefix="fsync") as pool:
                    list(pool.map(sync, paths[done:]))
                return
            sync(path)

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Move synced files to their final paths, so that they survive a power cut; files that were moved are skipped."""
        folders: dict[AnyPath, None] = {}
        for staged, target in ((Path(str(old)), Path(str(new))) for old, new in moves.items()):
            _move(staged, target)
            folders |= dict.fromkeys(takewhile(lambda folder: folder != self.root, target.parents))
        self.sync([*folders, self.root])

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments and empty folders; garbage collection retries failed removals."""
        for path in (Path(str(one)) for one in paths):
            with suppress(OSError):
                path.unlink()
            with suppress(OSError):
                self._prune(path.parent)

    def _prune(self, folder: Path) -> None:
        while folder not in {self.segments, self.root / ATTACHMENTS, self.root}:
            folder.rmdir()
            folder = folder.parent

    def staged_files(self, session: str) -> list[AnyPath]:
        """Return the files that a session started and did not publish."""
        return [
            path
            for path in self.session(session).rglob("*")
            if path.is_file() and not path.name.startswith(self.lock(session).name)
        ]

    def discard(self, session: str) -> None:
        """Remove the staged files of a session."""
        shutil.rmtree(self.session(session), ignore_errors=True)


def encoded(part: str) -> str:
    """Return a component of a name as a path component; see the module docstring."""
    safe = _UNSAFE.sub(lambda match: b"%%%02X" % match.group()[0], part.encode()).decode()
    if len(safe) <= _LONGEST:
        return safe
    return f"{safe[:_LONGEST]}%{hashlib.sha256(part.encode()).hexdigest()[:16]}"


def _move(staged: Path, target: Path) -> None:
    for attempts_left in reversed(range(_ATTEMPTS)):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            staged.rename(target)
        except FileNotFoundError:  # a concurrent deletion may remove the empty folder
            if not staged.exists() and target.exists():
                return  # an earlier attempt moved the file
            if not attempts_left or not staged.exists():
                raise
        else:
            return


def fsync(path: Path) -> None:
    """Wait until the file's or folder's content is on the disk; Windows cannot open folders, and needs no such call."""
    if path.is_dir() and not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def new_session_id() -> str:
    """Return a ULID: 48 bits of milliseconds, 80 random bits, in 26 characters that sort by time."""
    number = (time.time_ns() // 1_000_000) << 80 | secrets.randbits(80)
    return "".join(_CROCKFORD[number >> shift & 31] for shift in range(125, -1, -5))


MARKER = "store.json"
CLAIMS, CHANGES = "claims", "changes"

_BEAT_S = 20.0
_SILENT_S = 180.0
"""Time without a heartbeat after which a writer is considered dead."""
_LAST_BEAT_S = 5.0
"""Time limit for a heartbeat that is in progress at the end of a session."""
_COPY_BYTES = 8 << 20


class ObjectFiles:
    """The files of the store behind the URL `root`; see `Files`."""

    def __init__(self, root: RemotePath) -> None:
        self.root = root
        self._unpublished: defaultdict[str, list[RemotePath]] = defaultdict(list)
        self._beats: dict[str, Heartbeat] = {}

    def is_there(self) -> bool:
        """Return whether the store exists."""
        with translate_errors(self.root):
            return (self.root / MARKER).is_file()

    def topic(self, sequence: str, topic: str) -> RemotePath:
        """Return the folder of a topic's segments."""
        parts = (sequence, *topic.strip("/").split("/"))
        return self.root / "/".join(("segments", *(encoded(part) for part in parts)))

    def staged(self, session: str, sequence: str, topic: str, number: int) -> RemotePath:
        """Return the final path of a segment, which is not in the catalog yet."""
        path = self.topic(sequence, topic) / f"{session}-{number:04}.parquet"
        self._unpublished[session].append(path)
        return path

    def attachment(self, sequence: str, name: str) -> RemotePath:
        """Return the path of an attachment."""
        return self.root / f"{ATTACHMENTS}/{encoded(sequence)}/{name}"

    def staged_attachment(self, session: str, sequence: str, name: str) -> RemotePath:
        """Return the final path of an attachment, which is not in the catalog yet."""
        path = self.attachment(sequence, name)
        self._unpublished[session].append(path)
        return path

    def relative(self, path: AnyPath) -> str:
        """Return a segment's path relative to the store, as in the catalog."""
        return str(path).removeprefix(f"{self.root}/")

    def begin(self, session: str) -> Heartbeat:
        """Start the heartbeat of a session, which runs until the lease is released."""
        with translate_errors(self.root):
            beat = self._beats[session] = Heartbeat(self._session(session))
        return beat

    def is_live(self, session: str) -> bool:
        """Return whether the session has a recent heartbeat, by the clock of the store."""
        with translate_errors(self.root):
            try:
                last_beat_ns = self._session(session).stat().st_mtime_ns
            except FileNotFoundError:
                return False
            return self.now_ns() - last_beat_ns < _SILENT_S * 1e9

    def in_use(self, session: str, grace_s: float) -> bool:  # noqa: ARG002 - the heartbeat starts before the first file
        """Return whether the session's writer is alive."""
        return self.is_live(session)

    def sync(self, paths: Sequence[AnyPath]) -> None:
        """Return immediately, since closed files are stored."""

    def publish(self, moves: Mapping[AnyPath, AnyPath]) -> None:
        """Mark finished files as published; copy those whose final path has changed since they were written."""
        for path, final in moves.items():
            if path != final:
                self._copy(path, final)
        for session, unpublished in list(self._unpublished.items()):
            if any(path in moves for path in unpublished):
                self._beats[session].check()
                final = set(moves.values())
                unpublished[:] = [path for path in unpublished if path not in final]

    def _copy(self, path: AnyPath, final: AnyPath) -> None:
        """Copy a segment; the original stays unpublished, so that the end of its session removes it."""
        session = next(key for key, unpublished in self._unpublished.items() if path in unpublished)
        remote = cast("RemotePath", final)
        self._unpublished[session].append(remote)
        with translate_errors(remote), path.open("rb") as source, remote.open_output() as target:
            shutil.copyfileobj(source, target, _COPY_BYTES)

    def remove(self, paths: Iterable[AnyPath]) -> None:
        """Remove segments; garbage collection retries failed removals."""
        with ThreadPoolExecutor(_THREADS, thread_name_prefix="remove") as pool:
            list(pool.map(_remove, paths))

    def discard(self, session: str) -> None:
        """Remove the unpublished files of a session; if the store is unavailable, garbage collection removes them."""
        unpublished = self._unpublished.pop(session, [])
        self._beats.pop(session, None)
        try:
            self._session(session).unlink()
        except FileNotFoundError:  # removed by garbage collection; files written since then remain
            pass
        except (IngestError, OSError):
            return
        self.remove(unpublished)

    def open_sessions(self) -> list[str]:
        """Return the sessions that were started and not ended, alive or not."""
        return [path.name for path in (self.root / "sessions").iterdir() if path.is_file()]

    def staged_files(self, session: str) -> list[AnyPath]:  # noqa: ARG002 - the signature of `Files`
        """Return nothing, since unpublished segments are among the segment files."""
        return []

    def segment_files(self) -> Iterator[AnyPath]:
        """Yield every file below the folders of segments and attachments."""
        for folder in ("segments", ATTACHMENTS):
            below = (self.root / folder).listing(recursive=True)
            yield from (path for path in below if path.is_file())

    def _session(self, session: str) -> RemotePath:
        return self.root / f"sessions/{session}"

    def now_ns(self) -> int:
        """Return the time of the store's clock, which all writers share."""
        clock = self.root / "clock"
        clock.write_bytes(b"")
        return clock.stat().st_mtime_ns


class Heartbeat:
    """Rewrites an object regularly until it is released or the process ends."""

    def __init__(self, path: RemotePath) -> None:
        self._path = path
        self._stop = threading.Event()
        self._path.write_bytes(b"")
        self._last_beat_s = time.monotonic()
        self._thread = threading.Thread(target=self._beat, name="mosaico-heartbeat", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise if other processes may consider this writer dead, and may have removed its files."""
        if time.monotonic() - self._last_beat_s > _SILENT_S:
            raise SinkUnavailable(
                f"no heartbeat of the session reached the store for {_SILENT_S:.0f} s",
                where=str(self._path),
                hint="run again",
            )

    def release(self) -> None:
        """Stop; a second call has no effect."""
        self._stop.set()
        self._thread.join(_LAST_BEAT_S)

    def _beat(self) -> None:
        while not self._stop.wait(_BEAT_S):
            start_s = time.monotonic()
            with suppress(IngestError, OSError):  # the next heartbeat may succeed
                self._path.write_bytes(b"")
                self._last_beat_s = start_s


def _remove(path: AnyPath) -> None:
    with suppress(IngestError, OSError):
        path.unlink()
