"""Byte sources of containers: local files and files behind URLs."""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

from msgspec import Struct

from mosaico_ingest.errors import BagError, Unreachable
from mosaico_ingest.remote import AnyPath, RemotePath, reaching
from mosaico_ingest.rosbag.compression import room

__all__ = [
    "Fields",
    "FileSource",
    "RemoteSource",
    "Source",
    "Stretches",
    "Window",
    "check_inside",
    "fetch",
]

_WINDOW_BYTES = 1 << 16


class Source(Protocol):
    """What containers read from, by position."""

    @property
    def path(self) -> AnyPath:
        """The file as it was named, not a copy that had to be made."""
        ...

    @property
    def size(self) -> int:
        """Its length in bytes."""
        ...

    @property
    def notes(self) -> list[str]:
        """What is worth saying about how it is read."""
        ...

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset` on; BagError where there are fewer."""
        ...

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset` on, fewer only where the file ends."""
        ...

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset` on; BagError where there are fewer."""
        ...

    def prefetch(self, stretches: Iterable[tuple[int, int]]) -> None:
        """Announce what will be read next, in this order, each as its first byte and the one behind its last."""
        ...

    def fetch_whole(self) -> None:
        """Prepare for all of it being read in small steps."""
        ...

    def check_unchanged(self) -> None:
        """Raise where it has changed since it was opened; called once all of it was read."""
        ...

    def close(self) -> None:
        """Close it; closing twice does no harm."""
        ...


class FileSource:
    """A file opened for reading by position.

    Not a memory map: a file that is cut off while it is read must end in an error, not in a signal.
    """

    def __init__(self, path: Path, name: AnyPath | None = None) -> None:
        self.path: AnyPath = name or path
        self.notes: list[str] = []
        try:
            self._fd = os.open(path, os.O_RDONLY)
            self.size = os.fstat(self._fd).st_size
        except OSError as err:
            raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset` on.

        Raises:
            BagError: The file ends before that, or the disk refuses.
        """
        check_inside(self, offset, size)
        data = self.read_some(offset, size)
        self._check_found(len(data), offset, size)
        return data

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset` on.

        Raises:
            BagError: The file ends before that, or the disk refuses.
        """
        check_inside(self, offset, len(target))
        found = 0
        try:
            while found < len(target) and (more := os.preadv(self._fd, [target[found:]], offset + found)):
                found += more
        except OSError as err:
            raise self._refused(offset, err) from err
        self._check_found(found, offset, len(target))

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset` on, fewer only where the file ends.

        Raises:
            BagError: The disk refuses.
        """
        try:
            data = os.pread(self._fd, size, offset)
            while len(data) < size and (more := os.pread(self._fd, size - len(data), offset + len(data))):
                data += more
        except OSError as err:
            raise self._refused(offset, err) from err
        return data

    def _refused(self, offset: int, err: OSError) -> BagError:
        return BagError(f"cannot be read at {offset}: {err.strerror}", where=str(self.path))

    def _check_found(self, found: int, offset: int, size: int) -> None:
        if found < size:
            raise BagError(
                f"{size} bytes expected at {offset}, {found} found: the file became shorter",
                where=str(self.path),
            )

    def prefetch(self, stretches: Iterable[tuple[int, int]]) -> None:
        """Do nothing: the system reads ahead by itself."""

    def fetch_whole(self) -> None:
        """Do nothing: it is here."""

    def check_unchanged(self) -> None:
        """Do nothing: an open file stays what it is, unless it is written to."""

    def close(self) -> None:
        """Close the file; once is enough, twice does no harm."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class Stretches:
    """Reads stretches of a file into one buffer, one behind the other."""

    def __init__(self, source: Source, stretches: Iterable[tuple[int, int]]) -> None:
        """Make room for those that lie in the file; each is its first byte and the one behind its last."""
        inside = (stop - start for start, stop in stretches if 0 <= start <= stop <= source.size)
        self.data = room(sum(inside))
        """What was read, and room for the rest."""
        self._source = source
        self._used = 0

    def read(self, start: int, stop: int) -> slice:
        """Read one of the stretches and return where in `data` it lies.

        Raises:
            BagError: The file ends before that, or the disk refuses.
        """
        check_inside(self._source, start, stop - start)
        at = slice(self._used, self._used + stop - start)
        self._source.read_into(self.data[at].data, start)
        self._used = at.stop
        return at


def check_inside(source: Source, offset: int, size: int) -> None:
    """Raise where a stretch does not lie in the file."""
    if offset < 0 or size < 0 or offset + size > source.size:
        raise BagError(
            f"{size} bytes expected at {offset}, the file ends at {source.size}", where=str(source.path)
        )


class Window:
    """Looks at a file in small steps forward, reading it in large ones."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._data = b""
        self._at = 0

    def peek(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset` on, fewer at the end of the file."""
        begin = offset - self._at
        if begin < 0 or begin + size > len(self._data):
            left = max(self._source.size - offset, 0)
            self._data = self._source.read_some(offset, min(max(size, _WINDOW_BYTES), left))
            self._at, begin = offset, 0
        return self._data[begin : begin + size]


class Fields:
    """Takes little-endian values off a record's bytes, one after the other.

    Every method raises BagError where the record ends too early.
    """

    __slots__ = ("_data", "_end", "_pos")

    def __init__(self, data: bytes | memoryview, start: int = 0, end: int | None = None) -> None:
        self._data = data
        self._pos = start
        self._end = len(data) if end is None else end

    @property
    def left(self) -> int:
        """How many bytes have not been taken."""
        return self._end - self._pos

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes."""
        if size > self.left:
            raise BagError(f"a field of {size} bytes in a record with {self.left} left")
        self._pos += size
        return bytes(self._data[self._pos - size : self._pos])

    def u16(self) -> int:
        """Return an unsigned 16-bit number."""
        return int.from_bytes(self.take(2), "little")

    def u32(self) -> int:
        """Return an unsigned 32-bit number."""
        return int.from_bytes(self.take(4), "little")

    def u64(self) -> int:
        """Return an unsigned 64-bit number."""
        return int.from_bytes(self.take(8), "little")

    def text(self) -> str:
        """Return a string behind its 32-bit length; bytes that are no UTF-8 become U+FFFD."""
        return self.take(self.u32()).decode("utf-8", "replace")

    def texts(self) -> dict[str, str]:
        """Return a map of strings behind its length in bytes."""
        inner = Fields(self.take(self.u32()))
        found: dict[str, str] = {}
        while inner.left:
            name = inner.text()
            found[name] = inner.text()
        return found

    def pairs(self, code: str) -> list[tuple[int, int]]:
        """Return a map of numbers behind its length in bytes; `code` is the entry as `struct` spells it."""
        data = self.take(self.u32())
        layout = struct.Struct(code)
        if len(data) % layout.size:
            raise BagError(f"a map of {len(data)} bytes, which is no multiple of {layout.size}")
        return [(int(a), int(b)) for a, b in layout.iter_unpack(data)]


_LOOK_BYTES = 256 << 10
"""What is asked for where less is needed: a request costs more than its first bytes."""
_LOOKS = 8
_FIRST_BYTES, _REQUEST_BYTES = 1 << 20, 8 << 20
"""How much is asked for at once: little at first, as the reader may stop soon, then twice as much each time."""
_GAP_BYTES = 512 << 10
"""What lies between two stretches and is fetched with them rather than asked for around."""
_REQUESTS = 4
"""How many requests are under way at a time; with their answers they hold at most 32 MiB."""


class _Stretch(Struct, frozen=True):
    start: int
    data: bytes

    def has(self, start: int, stop: int) -> bool:
        return self.start <= start and stop <= self.start + len(self.data)

    def cut(self, start: int, stop: int) -> bytes:
        return self.data[start - self.start : stop - self.start]


class RemoteSource:
    """An object opened for reading by position; it must not change until it has been read.

    Every method that reads raises `Unreachable` where its store does not answer, or where the object is another now.
    """

    def __init__(self, path: RemotePath) -> None:
        self.path = path
        self.notes: list[str] = []
        self._near: FileSource | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._ahead: _Ahead | None = None
        self._looks: deque[_Stretch] = deque(maxlen=_LOOKS)
        try:
            self._file = path.open_input()
            with reaching(str(path)):
                self.size: int = self._file.size()
                self._version = path.version(self._file)
        except FileNotFoundError as err:
            raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset` on; see `FileSource.read`."""
        check_inside(self, offset, size)
        return self.read_some(offset, size)

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset` on; see `FileSource.read_into`."""
        if self._near is not None:
            self._near.read_into(target, offset)
        else:
            target[:] = self.read(offset, len(target))

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset` on, fewer only where the file ends."""
        if self._near is not None:
            return self._near.read_some(offset, size)
        stop = min(offset + size, self.size)
        if offset >= stop:
            return b""
        expected = self._ahead.take(offset, stop) if self._ahead else None
        return self._look(offset, stop) if expected is None else expected

    def prefetch(self, stretches: Iterable[tuple[int, int]]) -> None:
        """Begin to fetch what will be read next, in this order; each stretch is its first byte and the one behind."""
        self._forget()
        if self._near is None:
            self._ahead = _Ahead(self._fetch, _requests(iter(stretches)))

    def fetch_whole(self) -> None:
        """Fetch the whole object to a temporary folder, for many small reads; `close` removes it."""
        if self._near is None:
            self._folder = tempfile.TemporaryDirectory(prefix="mosaico-")
            self._near = FileSource(_save(self, Path(self._folder.name)), self.path)
            self.notes.append(f"it has no index, so all of its {self.size} bytes were fetched first")

    def check_unchanged(self) -> None:
        """Raise where the object is no longer the one that was opened."""
        self._forget()
        self._check_version()

    def _check_version(self) -> None:
        if self.path.version() != self._version:
            raise Unreachable(
                "the recording changed while it was read", where=str(self.path), hint="run again"
            )

    def close(self) -> None:
        """Close the object, and remove what was fetched; closing twice does no harm."""
        self._forget()
        self._file.close()
        if self._near is not None and self._folder is not None:
            self._near.close()
            self._folder.cleanup()

    def _forget(self) -> None:
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def _look(self, start: int, stop: int) -> bytes:
        """Return a stretch that was not prefetched; some of what lies around it is kept."""
        for known in self._looks:
            if known.has(start, stop):
                return known.cut(start, stop)
        first = max(0, min(start, self.size - _LOOK_BYTES))
        data = self._fetch(first, max(stop, min(first + _LOOK_BYTES, self.size)))
        found = _Stretch(first, data)
        if len(data) <= _LOOK_BYTES:
            self._looks.append(found)
        return found.cut(start, stop)

    def _fetch(self, start: int, stop: int) -> bytes:
        try:
            with reaching(str(self.path)):
                data = self._file.read_at(stop - start, start)  # pyright: ignore[reportCallIssue] - the stubs leave the arguments out
        except Unreachable:
            raise
        except Exception:
            self._check_version()  # a store says of an object that was replaced that there is no such range
            raise
        if len(data) != stop - start:
            self._check_version()
            raise BagError(
                f"{stop - start} bytes expected at {start}, {len(data)} sent", where=str(self.path)
            )
        return data


class _Ahead:
    """Fetches stretches before they are asked for, in order; no more at a time than the reader has shown to need."""

    def __init__(self, fetch: Callable[[int, int], bytes], wanted: Iterator[tuple[int, int]]) -> None:
        self._fetch = fetch
        self._wanted = wanted
        self._under_way: deque[tuple[int, int, Future[bytes]]] = deque()
        self._allowed = 1
        self._pool = ThreadPoolExecutor(_REQUESTS, thread_name_prefix="mosaico-fetch")
        self._lock = threading.Lock()
        self._fill()

    def take(self, start: int, stop: int) -> bytes | None:
        """Return a stretch that was announced, None for any other."""
        with self._lock:
            place = next((i for i, (a, b, _) in enumerate(self._under_way) if a <= start and stop <= b), None)
            if place is None:
                return None
            for _ in range(place):
                self._under_way.popleft()
            if place:
                self._allowed = min(self._allowed + 1, _REQUESTS)
            self._fill()
            first, _, fetched = self._under_way[0]
        return fetched.result()[start - first : stop - first]

    def close(self) -> None:
        """Give up what has not been asked for yet."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _fill(self) -> None:
        while len(self._under_way) < self._allowed:
            following = next(self._wanted, None)
            if following is None:
                return
            self._under_way.append((*following, self._pool.submit(self._fetch, *following)))


def _requests(stretches: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Join neighbours to requests of a good size."""
    limit = _FIRST_BYTES
    begun: tuple[int, int] | None = None
    for start, stop in stretches:
        if begun and 0 <= start - begun[1] <= _GAP_BYTES and stop - begun[0] <= limit:
            begun = (begun[0], stop)
            continue
        if begun:
            yield begun
            limit = min(2 * limit, _REQUEST_BYTES)
        begun = (start, stop)
    if begun:
        yield begun


def fetch(path: RemotePath, folder: Path) -> Path:
    """Copy an object into a folder, checking first that it fits.

    Raises:
        BagError: There is no such object, or not enough room.
        Unreachable: Its store does not answer, or it changed meanwhile.
    """
    source = RemoteSource(path)
    try:
        target = _save(source, folder)
        source.check_unchanged()
    finally:
        source.close()
    return target


def _save(source: RemoteSource, folder: Path) -> Path:
    free = shutil.disk_usage(folder).free
    hint = "point TMPDIR at a larger disk"
    if source.size > free:
        raise BagError(
            f"{source.size} bytes are to be fetched to {folder}, and {free} are free",
            where=str(source.path),
            hint=hint,
        )
    target = folder / source.path.name
    steps = [(at, min(at + _REQUEST_BYTES, source.size)) for at in range(0, source.size, _REQUEST_BYTES)]
    source.prefetch(steps)
    try:
        with target.open("wb") as file:
            for start, stop in steps:
                file.write(source.read_some(start, stop - start))
    except OSError as err:
        raise BagError(
            f"cannot be fetched to {folder}: {err.strerror}", where=str(source.path), hint=hint
        ) from err
    return target
