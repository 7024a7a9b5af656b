"""This file reads stretches of a file; a stretch that is not there is an error, never a crash."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from mosaico_ingest.bag.room import room
from mosaico_ingest.errors import BagError
from mosaico_ingest.remote.path import AnyPath

__all__ = ["Fields", "FileSource", "Source", "Stretches", "Window", "check_inside"]

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
