"""Recordings that arrive in a folder or behind a URL, and whether they are complete."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, BinaryIO, TypeAlias

from mosaico_ingest.containers import ACTIVE_SUFFIX, MCAP, RECORDING_NAME
from mosaico_ingest.remote import AnyPath, RemotePath

_METADATA = "metadata.yaml"
_FIRST_RETRY_S, _LAST_RETRY_S = 60.0, 3600.0
_ROS1 = b"#ROSBAG V2.0\n"
_INDEX_OFFSET = b"index_pos="
_SQLITE = b"SQLite format 3\x00"
_HEAD_BYTES = 4096
_FileStates: TypeAlias = tuple[tuple[str, int, int], ...]
"""Name, size and modification time of each file of a recording."""


@dataclass(slots=True)
class _Arrival:
    files: _FileStates
    since: float
    """When these files were first seen."""
    settled: bool = False
    retry_at: float | None = None
    delay_s: float = _FIRST_RETRY_S


@dataclass(slots=True)
class Arrivals:
    """The recordings in a folder and its subfolders; hidden files, which copying programs use, are ignored."""

    folder: AnyPath
    rest_s: float
    """Seconds without a change after which a recording is complete."""
    unfinished_rest_s: float = 600.0
    """Seconds without a change for a recording without its end: its upload may have stalled, or its recorder crashed."""
    _arrivals: dict[AnyPath, _Arrival] = field(default_factory=dict)

    def settled(self, now: float) -> tuple[AnyPath, ...]:
        """Return the recordings that became complete since the last call; each once until it changes.

        `now` is a monotonic time in seconds.
        """
        states = {path: files for path in _recordings(self.folder) if (files := _file_states(path))}
        self._arrivals = {path: arrival for path, arrival in self._arrivals.items() if path in states}
        return tuple(path for path, files in sorted(states.items()) if self._has_settled(path, files, now))

    def complete(self) -> tuple[AnyPath, ...]:
        """Return all complete recordings, including the results of earlier calls of `settled`."""
        return tuple(path for path, arrival in sorted(self._arrivals.items()) if arrival.settled)

    def unfinished(self) -> tuple[AnyPath, ...]:
        """Return the recordings that are not settled because their end is missing."""
        return tuple(
            path
            for path, arrival in sorted(self._arrivals.items())
            if not arrival.settled and _is_growing(path)
        )

    def again(self, path: AnyPath, now: float) -> float:
        """Schedule a recording that failed to settle again, and return the delay in seconds; it doubles every time."""
        arrival = self._arrivals[path]
        delay_s, arrival.delay_s = arrival.delay_s, min(2 * arrival.delay_s, _LAST_RETRY_S)
        arrival.retry_at = now + delay_s
        return delay_s

    def _has_settled(self, path: AnyPath, files: _FileStates, now: float) -> bool:
        arrival = self._arrivals.get(path)
        if arrival is None or arrival.files != files:
            arrival = self._arrivals[path] = _Arrival(files, now)
        if arrival.retry_at is not None and now >= arrival.retry_at:
            arrival.settled, arrival.retry_at = False, None
        if arrival.settled or now - arrival.since < self.rest_s or any(map(_is_open, _files(path))):
            return False
        age_s = time.time() - max(modified_ns for _, _, modified_ns in files) / 1e9
        if age_s < self.unfinished_rest_s and _is_growing(path):
            return False
        arrival.settled = True
        return True


def is_unfinished(path: AnyPath) -> bool:
    """Return whether the end of a recording's file is missing: still being written, stalled, or truncated.

    MCAP files end with their magic bytes, ROS 1 bags have the offset of their index in their header, and SQLite databases
    have their number of pages. Other files, such as compressed ones, have no such mark. Objects behind URLs appear when they are
    complete.
    """
    if isinstance(path, RemotePath):
        return False
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
            size = file.seek(0, 2)
            if head.startswith(MCAP):
                return not _ends_with_magic(file, size)
            if head.startswith(_ROS1):
                return not _ends_with_index(file, head, size)
            if head.startswith(_SQLITE) and len(head) >= 32:  # noqa: PLR2004 - the end of the page count
                page_bytes = int.from_bytes(head[16:18], "big")
                page_count = int.from_bytes(head[28:32], "big")
                return size < page_count * (1 << 16 if page_bytes == 1 else page_bytes)
    except OSError:
        pass  # opening the recording reports the error
    return False


def _ends_with_magic(file: BinaryIO, size: int) -> bool:
    file.seek(max(0, size - len(MCAP)))
    return size >= 2 * len(MCAP) and file.read() == MCAP


def _ends_with_index(file: BinaryIO, head: bytes, size: int) -> bool:
    """Return whether the index records of a ROS 1 bag end exactly at the end of the file."""
    position = head.find(_INDEX_OFFSET)
    if position < 0:
        return True  # not a bag header; opening the recording reports the error
    (offset,) = struct.unpack_from("<Q", head, position + len(_INDEX_OFFSET))
    if not 0 < offset < size:
        return False
    file.seek(offset)
    index = file.read()
    end = 0
    while end < len(index):  # a record is a header and data, each after its length
        for _ in range(2):
            if end + 4 > len(index):
                return False
            end += 4 + int.from_bytes(index[end : end + 4], "little")
    return end == len(index)


def _is_growing(path: AnyPath) -> bool:
    return any(is_unfinished(file) for file in _files(path))


def _recordings(folder: AnyPath, parents: frozenset[AnyPath] = frozenset()) -> Iterator[AnyPath]:
    """Yield recordings: files, and rosbag2 directories that have their metadata.yaml, which is written last.

    Links that lead back to one of the parents are ignored.
    """
    resolved = folder.resolve()
    if resolved in parents:
        return
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError:  # the folder was removed, or may not be listed
        return
    if any(entry.name == _METADATA for entry in entries):
        yield folder
        return
    for entry in entries:
        if entry.is_dir():
            yield from _recordings(entry, parents | {resolved})
        elif entry.name.endswith(ACTIVE_SUFFIX):
            continue  # the recorder renames the file when it is complete
        elif RECORDING_NAME.search(entry.name) and not _is_split(entry):
            yield entry


def _is_split(file: AnyPath) -> bool:
    """Return whether a file is named like a split of a rosbag2 directory, with which it is ingested."""
    return re.match(rf"{re.escape(file.parent.name)}_\d+\.(db3|mcap)", file.name) is not None


def _files(path: AnyPath) -> list[AnyPath]:
    with suppress(OSError):
        return [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
    return []


def _file_states(path: AnyPath) -> _FileStates:
    try:
        states = [(file.name, file.stat()) for file in sorted(_files(path))]
    except OSError:
        return ()
    return tuple((name, state.st_size, state.st_mtime_ns) for name, state in states if state.st_size)


_fcntl: Any = import_module("fcntl") if find_spec("fcntl") else None
"""File leases; None on Windows."""


def _is_open(file: AnyPath) -> bool:
    """Return whether a process has the file open for writing; Linux grants no read lease in this case."""
    if isinstance(file, RemotePath) or _fcntl is None or not hasattr(_fcntl, "F_SETLEASE"):
        return False
    try:
        with file.open("rb") as opened:
            _fcntl.fcntl(opened, _fcntl.F_SETLEASE, _fcntl.F_RDLCK)
            _fcntl.fcntl(opened, _fcntl.F_SETLEASE, _fcntl.F_UNLCK)
    except BlockingIOError:
        return True
    except OSError:  # a file of another user, or a file system without leases: only the time of rest decides
        return False
    return False
