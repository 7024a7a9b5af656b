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
from mosaico_ingest.remote import AnyPath, RemotePath, translate_errors
from mosaico_ingest.rosbag.compression import allocate

_WINDOW_BYTES = 1 << 16
_SEARCH_BYTES = 1 << 20
_SEARCH_OVERLAP_BYTES = 1 << 10
"""Overlap of two steps of a search; more than any pattern spans."""


class Source(Protocol):
    """A file with random access: the interface that container readers use."""

    @property
    def path(self) -> AnyPath:
        """The path that the caller named, even if a temporary copy is read."""
        ...

    @property
    def size(self) -> int:
        """Length in bytes."""
        ...

    @property
    def notes(self) -> list[str]:
        """Remarks about how the file is read."""
        ...

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset`; raise BagError if the file ends before."""
        ...

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset`; fewer only at the end of the file."""
        ...

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset`; raise BagError if the file ends before."""
        ...

    def prefetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce the ranges (start, end) that will be read next, in this order."""
        ...

    def fetch_whole(self) -> None:
        """Prepare for reading the complete file in small steps."""
        ...

    def check_unchanged(self) -> None:
        """Raise if the file has changed since it was opened; called after the last read."""
        ...

    def close(self) -> None:
        """Close the file. Closing twice is harmless."""
        ...


_SEEKING = threading.Lock()
"""Held for each read on systems without `pread`, where a read moves the position of the file."""


def _read_at(fd: int, size: int, offset: int) -> bytes:
    if hasattr(os, "pread"):
        return os.pread(fd, size, offset)
    with _SEEKING:
        os.lseek(fd, offset, os.SEEK_SET)
        return os.read(fd, size)


def _fill(fd: int, target: memoryview, offset: int) -> int:
    """Fill the start of `target`, and return the number of bytes read."""
    if hasattr(os, "preadv"):
        return os.preadv(fd, [target], offset)
    data = _read_at(fd, len(target), offset)
    target[: len(data)] = data
    return len(data)


class FileSource:
    """A local file.

    It is read with `pread`, not with a memory map: truncating the file during a read must raise an error, not a signal.
    """

    def __init__(self, path: Path, name: AnyPath | None = None) -> None:
        self.path: AnyPath = name or path
        self.notes: list[str] = []
        try:
            self._fd = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
            self.size = os.fstat(self._fd).st_size
        except OSError as err:
            raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset`.

        Raises:
            BagError: The file ends before, or the operating system reports an error.
        """
        check_inside(self, offset, size)
        data = self.read_some(offset, size)
        self._check_length(len(data), offset, size)
        return data

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset`.

        Raises:
            BagError: The file ends before, or the operating system reports an error.
        """
        check_inside(self, offset, len(target))
        filled = 0
        try:
            while filled < len(target) and (more := _fill(self._fd, target[filled:], offset + filled)):
                filled += more
        except OSError as err:
            raise self._read_error(offset, err) from err
        self._check_length(filled, offset, len(target))

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset`; fewer only at the end of the file.

        Raises:
            BagError: The operating system reports an error.
        """
        try:
            data = _read_at(self._fd, size, offset)
            while len(data) < size and (more := _read_at(self._fd, size - len(data), offset + len(data))):
                data += more
        except OSError as err:
            raise self._read_error(offset, err) from err
        return data

    def _read_error(self, offset: int, err: OSError) -> BagError:
        return BagError(f"cannot be read at {offset}: {err.strerror}", where=str(self.path))

    def _check_length(self, length: int, offset: int, size: int) -> None:
        if length < size:
            raise BagError(
                f"{size} bytes expected at {offset}, {length} read: the file was truncated",
                where=str(self.path),
            )

    def prefetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Do nothing: the operating system reads ahead."""

    def fetch_whole(self) -> None:
        """Do nothing: the file is local."""

    def check_unchanged(self) -> None:
        """Do nothing: an open local file cannot be replaced."""

    def close(self) -> None:
        """Close the file. Closing twice is harmless."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class ReadBuffer:
    """Reads several ranges of a file into one buffer, one after the other."""

    def __init__(self, source: Source, ranges: Iterable[tuple[int, int]]) -> None:
        """Allocate space for the ranges (start, end) that are inside the file."""
        inside = (stop - start for start, stop in ranges if 0 <= start <= stop <= source.size)
        self.data = allocate(sum(inside))
        """The bytes read so far, followed by unused space."""
        self._source = source
        self._used = 0

    def read(self, start: int, stop: int) -> slice:
        """Read one of the ranges and return its position in `data`.

        Raises:
            BagError: The file ends before, or the operating system reports an error.
        """
        check_inside(self._source, start, stop - start)
        position = slice(self._used, self._used + stop - start)
        self._source.read_into(self.data[position].data, start)
        self._used = position.stop
        return position


def check_inside(source: Source, offset: int, size: int) -> None:
    """Raise BagError if a range is not inside the file."""
    if offset < 0 or size < 0 or offset + size > source.size:
        raise BagError(
            f"{size} bytes expected at {offset}, the file ends at {source.size}", where=str(source.path)
        )


class Window:
    """A read buffer for small forward steps through a file."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._data = b""
        self._offset = 0

    def peek(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset`; fewer at the end of the file."""
        start = offset - self._offset
        if start < 0 or start + size > len(self._data):
            available = max(self._source.size - offset, 0)
            self._data = self._source.read_some(offset, min(max(size, _WINDOW_BYTES), available))
            self._offset, start = offset, 0
        return self._data[start : start + size]


def find_record(
    source: Source,
    start: int,
    stop: int,
    candidates: Callable[[bytes], Iterator[int]],
    is_record: Callable[[int], bool],
) -> int | None:
    """Return the offset of the next record between `start` and `stop` after bytes that are not valid records.

    `candidates` yields the positions within some bytes where a record may start, and `is_record` checks a file offset.
    """
    while start < stop:
        data = source.read_some(start, min(_SEARCH_BYTES, stop - start))
        for candidate in candidates(data):
            if is_record(start + candidate):
                return start + candidate
        if len(data) < _SEARCH_BYTES:
            return None
        start += _SEARCH_BYTES - _SEARCH_OVERLAP_BYTES
    return None


class Fields:
    """Reads little-endian values from the bytes of a record, one after the other.

    Every method raises BagError if the record ends before the value.
    """

    __slots__ = ("_data", "_end", "_pos")

    def __init__(self, data: bytes | memoryview, start: int = 0, end: int | None = None) -> None:
        self._data = data
        self._pos = start
        self._end = len(data) if end is None else end

    @property
    def left(self) -> int:
        """Number of remaining bytes."""
        return self._end - self._pos

    def take(self, size: int) -> bytes:
        """Return the next `size` bytes."""
        if size > self.left:
            raise BagError(f"a field of {size} bytes in a record with {self.left} bytes left")
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
        """Return a string that follows its 32-bit length; invalid UTF-8 becomes U+FFFD."""
        return self.take(self.u32()).decode("utf-8", "replace")

    def texts(self) -> dict[str, str]:
        """Return a map of strings that follows its length in bytes."""
        inner = Fields(self.take(self.u32()))
        texts: dict[str, str] = {}
        while inner.left:
            name = inner.text()
            texts[name] = inner.text()
        return texts

    def pairs(self, code: str) -> list[tuple[int, int]]:
        """Return a map of numbers that follows its length in bytes; `code` is the `struct` format of an entry."""
        data = self.take(self.u32())
        layout = struct.Struct(code)
        if len(data) % layout.size:
            raise BagError(f"a map of {len(data)} bytes, which is not a multiple of {layout.size}")
        return [(int(a), int(b)) for a, b in layout.iter_unpack(data)]


_PAGE_BYTES = 256 << 10
"""Minimum size of a request that was not announced; the round trip dominates the cost of small requests."""
_CACHED_PAGES = 8
_FIRST_REQUEST_BYTES, _REQUEST_BYTES = 1 << 20, 8 << 20
"""Size of the first prefetch request, and maximum size; requests double, because the reader may stop early."""
_MAX_GAP_BYTES = 512 << 10
"""Maximum gap between two ranges that are fetched with one request."""
_CONCURRENT_REQUESTS = 4
"""Maximum number of concurrent requests; their responses take at most 32 MiB."""
_LARGEST_WINDOW = _CONCURRENT_REQUESTS * _REQUEST_BYTES // _PAGE_BYTES
"""Number of pages that a scan fetches together: as many as all concurrent requests return."""


class _Range(Struct, frozen=True):
    start: int
    data: bytes

    def has(self, start: int, stop: int) -> bool:
        return self.start <= start and stop <= self.start + len(self.data)

    def cut(self, start: int, stop: int) -> bytes:
        return self.data[start - self.start : stop - self.start]


class RemoteSource:
    """A remote file. It must not change while it is open.

    Every method that reads raises `Unreachable` if the server does not respond or the file has been replaced.
    """

    def __init__(self, path: RemotePath) -> None:
        self.path = path
        self.notes: list[str] = []
        self._copy: FileSource | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._prefetcher: _Prefetcher | None = None
        self._pages: deque[_Range] = deque(maxlen=_CACHED_PAGES)
        try:
            self._file = path.open_input()
            self._read_range = path.range_reader(self._file)
            self.has_ranges = path.has_ranges
            """Whether the server sends ranges; otherwise, each range costs the bytes before it."""
            with translate_errors(str(path)):
                self.size: int = self._file.size()
                self._version = path.version(self._file)
        except FileNotFoundError as err:
            raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err

    def read(self, offset: int, size: int) -> bytes:
        """Return `size` bytes from `offset`; see `FileSource.read`."""
        check_inside(self, offset, size)
        return self.read_some(offset, size)

    def read_into(self, target: memoryview, offset: int) -> None:
        """Fill `target` with the bytes from `offset`; see `FileSource.read_into`."""
        if self._copy is not None:
            self._copy.read_into(target, offset)
        else:
            target[:] = self.read(offset, len(target))

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset`; fewer only at the end of the file."""
        if self._copy is not None:
            return self._copy.read_some(offset, size)
        stop = min(offset + size, self.size)
        if offset >= stop:
            return b""
        prefetched = self._prefetcher.take(offset, stop) if self._prefetcher else None
        return self._read_page(offset, stop) if prefetched is None else prefetched

    def prefetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Start to fetch the ranges (start, end) that will be read next, in this order."""
        self._stop_prefetching()
        if self._copy is None:
            self._prefetcher = _Prefetcher(self.fetch, _requests(iter(ranges)))

    def fetch_whole(self) -> None:
        """Download the complete file to a temporary folder, for many small reads; `close` removes it."""
        if self._copy is None:
            self._folder = tempfile.TemporaryDirectory(prefix="mosaico-")
            self._copy = FileSource(_save(self, Path(self._folder.name)), self.path)
            self.notes.append(f"it has no index, so all {self.size} bytes were downloaded")

    def check_unchanged(self) -> None:
        """Raise Unreachable if the file has been replaced since it was opened."""
        self._stop_prefetching()
        self._check_version()

    def _check_version(self) -> None:
        if self.path.version() != self._version:
            raise Unreachable(
                "the recording changed while it was being read", where=str(self.path), hint="run again"
            )

    def close(self) -> None:
        """Close the file and remove the local copy. Closing twice is harmless."""
        self._stop_prefetching()
        self._file.close()
        if self._copy is not None and self._folder is not None:
            self._copy.close()
            self._folder.cleanup()

    def _stop_prefetching(self) -> None:
        if self._prefetcher is not None:
            self._prefetcher.close()
            self._prefetcher = None

    def _read_page(self, start: int, stop: int) -> bytes:
        """Return a range that was not prefetched; cache the bytes around it."""
        for page in self._pages:
            if page.has(start, stop):
                return page.cut(start, stop)
        first = max(0, min(start, self.size - _PAGE_BYTES))
        page = _Range(first, self.fetch(first, max(stop, min(first + _PAGE_BYTES, self.size))))
        if len(page.data) <= _PAGE_BYTES:
            self._pages.append(page)
        return page.cut(start, stop)

    def fetch(self, start: int, stop: int) -> bytes:
        """Fetch a range with one request."""
        try:
            with translate_errors(str(self.path)):
                data = self._read_range(start, stop)
        except Unreachable:
            raise
        except Exception:
            self._check_version()  # for a replaced object, a store reports an invalid range
            raise
        if len(data) != stop - start:
            self._check_version()
            raise BagError(
                f"{stop - start} bytes expected at {start}, {len(data)} received", where=str(self.path)
            )
        return data


class CachedSource:
    """A remote file whose pages are cached in a temporary file, for readers that read pages more than once.

    Sequential misses double the number of pages per miss, so that a scan needs few requests, and a single page costs one
    small request.
    """

    def __init__(self, source: RemoteSource) -> None:
        """Take over a source; `close` closes it."""
        self.path = source.path
        self.size = source.size
        self._source = source
        self._cached = bytearray(-(-self.size // _PAGE_BYTES))
        """Whether each page is in the cache, as 0 or 1."""
        self._window = 1
        """Number of pages that the last sequential miss fetched."""
        self._folder = tempfile.TemporaryDirectory(prefix="mosaico-")
        self._output = Path(self._folder.name, "pages").open("wb", buffering=0)  # noqa: SIM115 - `close` closes it
        self._output.truncate(self.size)  # the file is sparse: pages take space when they are written
        self._cache = FileSource(Path(self._output.name), self.path)

    def read_some(self, offset: int, size: int) -> bytes:
        """Return up to `size` bytes from `offset`; fewer only at the end of the file."""
        stop = min(offset + size, self.size)
        for page in range(offset // _PAGE_BYTES, -(-stop // _PAGE_BYTES)):
            if not self._cached[page]:
                self._load(page)
        return self._cache.read_some(offset, size)

    def check_unchanged(self) -> None:
        """Raise Unreachable if the file has been replaced since it was opened."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close the file and remove the cache. Closing twice is harmless."""
        self._source.close()
        self._cache.close()
        self._output.close()
        self._folder.cleanup()

    def _load(self, page: int) -> None:
        """Fetch a page; after the page before it, fetch twice as many as at the last time."""
        is_sequential = page > 0 and self._cached[page - 1]
        if is_sequential:
            self._window = min(2 * self._window, _LARGEST_WINDOW)
        limit = min(page + (self._window if is_sequential else 1), len(self._cached))
        end = next((number for number in range(page, limit) if self._cached[number]), limit)
        stop = min(end * _PAGE_BYTES, self.size)
        starts = range(page * _PAGE_BYTES, stop, _REQUEST_BYTES)
        stops = [min(start + _REQUEST_BYTES, stop) for start in starts]
        with ThreadPoolExecutor(_CONCURRENT_REQUESTS, thread_name_prefix="mosaico-fetch") as pool:
            for start, data in zip(starts, pool.map(self._source.fetch, starts, stops), strict=True):
                self._write(start, data)
        self._cached[page:end] = bytes([1]) * (end - page)

    def _write(self, start: int, data: bytes) -> None:
        try:
            self._output.seek(start)
            self._output.write(data)
        except OSError as err:
            raise BagError(
                f"cannot be cached in {self._folder.name}: {err.strerror}",
                where=str(self.path),
                hint="point TMPDIR at a larger disk",
            ) from err


class _Prefetcher:
    """Fetches announced ranges in order before they are read; concurrency grows as the reader consumes them."""

    def __init__(self, fetch: Callable[[int, int], bytes], ranges: Iterator[tuple[int, int]]) -> None:
        self._fetch = fetch
        self._ranges = ranges
        self._following = next(ranges, None)
        """The next range that is not requested yet."""
        self._requests: deque[tuple[int, int, Future[bytes]]] = deque()
        self._allowed = 1
        self._pool = ThreadPoolExecutor(_CONCURRENT_REQUESTS, thread_name_prefix="mosaico-fetch")
        self._lock = threading.Lock()
        self._fill()

    def take(self, start: int, stop: int) -> bytes | None:
        """Return a range if it was announced, else None."""
        with self._lock:
            if self._following and self._following[0] <= start and stop <= self._following[1]:
                self._submit(self._following)
            index = next((i for i, (a, b, _) in enumerate(self._requests) if a <= start and stop <= b), None)
            if index is None:
                return None
            for _ in range(index):
                self._requests.popleft()
            if index:
                self._allowed = min(self._allowed + 1, _CONCURRENT_REQUESTS)
            self._fill()
            first, _, response = self._requests[0]
        return response.result()[start - first : stop - first]

    def close(self) -> None:
        """Cancel the requests that have not started, and wait for the others."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _fill(self) -> None:
        while self._following and len(self._requests) < self._allowed:
            self._submit(self._following)

    def _submit(self, request: tuple[int, int]) -> None:
        self._requests.append((*request, self._pool.submit(self._fetch, *request)))
        self._following = next(self._ranges, None)


def _requests(ranges: Iterator[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Merge neighboring ranges into requests."""
    limit = _FIRST_REQUEST_BYTES
    request: tuple[int, int] | None = None
    for start, stop in ranges:
        if request and 0 <= start - request[1] <= _MAX_GAP_BYTES and stop - request[0] <= limit:
            request = (request[0], stop)
            continue
        if request:
            yield request
            limit = min(2 * limit, _REQUEST_BYTES)
        request = (start, stop)
    if request:
        yield request


def download(path: RemotePath, folder: Path) -> Path:
    """Download a remote file into a folder, after checking that it fits.

    Raises:
        BagError: The file does not exist, or the disk has not enough space.
        Unreachable: The server does not respond, or the file changed meanwhile.
    """
    source = RemoteSource(path)
    try:
        target = _save(source, folder)
        source.check_unchanged()
    finally:
        source.close()
    return target


def _save(source: RemoteSource, folder: Path) -> Path:
    limit = source.path.network.max_download_bytes
    if limit is not None and source.size > limit:
        raise BagError(
            f"{source.size} bytes must be downloaded, and network.max_download is {limit}",
            where=str(source.path),
            hint="raise the limit, or convert the recording to MCAP, which is read by range",
        )
    free = shutil.disk_usage(folder).free
    hint = "point TMPDIR at a larger disk"
    if source.size > free:
        raise BagError(
            f"{source.size} bytes must be downloaded to {folder}, and only {free} are free",
            where=str(source.path),
            hint=hint,
        )
    target = folder / source.path.name
    steps = [(at, min(at + _REQUEST_BYTES, source.size)) for at in range(0, source.size, _REQUEST_BYTES)]
    if source.has_ranges:
        source.prefetch(steps)
    try:
        with target.open("wb") as file:
            for start, stop in steps:
                file.write(source.read_some(start, stop - start))
    except OSError as err:
        raise BagError(
            f"cannot be downloaded to {folder}: {err.strerror}", where=str(source.path), hint=hint
        ) from err
    return target
