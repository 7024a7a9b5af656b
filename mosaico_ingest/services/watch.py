"""This file finds recordings that arrive in a folder and have come to rest: whole, closed, no longer changing."""

from __future__ import annotations

import fcntl
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mosaico_ingest.rosbag.formats import RECORDING_NAME

__all__ = ["Arrivals"]

_METADATA = "metadata.yaml"
_FIRST_RETRY_S, _LAST_RETRY_S = 60.0, 3600.0
_Look = tuple[tuple[str, int, int], ...]
"""Name, size and time of change of each of a recording's files."""


@dataclass(slots=True)
class _Seen:
    look: _Look
    since: float
    taken: bool = False
    retry_at: float | None = None
    delay_s: float = _FIRST_RETRY_S


@dataclass(slots=True)
class Arrivals:
    """The recordings of a folder and of those in it; hidden files, as copying programs write them, are passed over."""

    folder: Path
    rest_s: float
    """How long a recording must not have changed."""
    _seen: dict[Path, _Seen] = field(default_factory=dict[Path, _Seen])

    def settled(self, now: float) -> tuple[Path, ...]:
        """Look once; return what has come to rest since the last look, each recording once until it changes."""
        found = {path: look for path in _recordings(self.folder) if (look := _look(path))}
        self._seen = {path: seen for path, seen in self._seen.items() if path in found}
        return tuple(path for path, look in sorted(found.items()) if self._has_settled(path, look, now))

    def again(self, path: Path, now: float) -> float:
        """Return the seconds until a recording that failed is given out once more; doubled every time."""
        seen = self._seen[path]
        wait_s, seen.delay_s = seen.delay_s, min(2 * seen.delay_s, _LAST_RETRY_S)
        seen.retry_at = now + wait_s
        return wait_s

    def _has_settled(self, path: Path, look: _Look, now: float) -> bool:
        seen = self._seen.get(path)
        if seen is None or seen.look != look:
            seen = self._seen[path] = _Seen(look, now)
        if seen.retry_at is not None and now >= seen.retry_at:
            seen.taken, seen.retry_at = False, None
        if seen.taken or now - seen.since < self.rest_s or any(map(_is_written, _files(path))):
            return False
        seen.taken = True
        return True


def _recordings(folder: Path, above: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """Yield files, and rosbag2 directories as one; one that is not finished has no metadata.yaml yet.

    A link that leads back to a folder `above` is not followed.
    """
    here = folder.resolve()
    if here in above:
        return
    try:
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError:  # it has gone, or may not be listed
        return
    if any(entry.name == _METADATA for entry in entries):
        yield folder
        return
    for entry in entries:
        if entry.is_dir():
            yield from _recordings(entry, above | {here})
        elif RECORDING_NAME.search(entry.name) and not _is_split(entry):
            yield entry


def _is_split(file: Path) -> bool:
    """Say whether a file is named as rosbag2 names those of a directory: it is ingested with the others."""
    return re.match(rf"{re.escape(file.parent.name)}_\d+\.(db3|mcap)", file.name) is not None


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]


def _look(path: Path) -> _Look:
    try:
        stats = [(file.name, file.stat()) for file in sorted(_files(path))]
    except OSError:
        return ()
    return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats if stat.st_size)


def _is_written(file: Path) -> bool:
    """Say whether somebody has the file open for writing, where the system tells: Linux grants no read lease then."""
    if not hasattr(fcntl, "F_SETLEASE"):
        return False
    try:
        with file.open("rb") as opened:
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except BlockingIOError:
        return True
    except OSError:  # not our file, or a file system without leases: the time at rest must do
        return False
    return False
