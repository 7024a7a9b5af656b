"""This file is where things lie in a store behind a URL.

    store.json                               that there is a store, and its format
    catalog/<sequence>.json                  all that is known of a sequence
    segments/<sequence>/<topic…>/<session>-<number>.parquet
    claims/<sequence>/<session>              who is writing a sequence
    sessions/<session>                       that a writer lives: written again and again while it does

Nothing can be renamed there, so segments are written in their places; only those a catalog entry names count.
"""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from mosaico_ingest.errors import IngestError, SinkUnavailable
from mosaico_ingest.remote.path import AnyPath, RemotePath
from mosaico_ingest.store.faults import explained
from mosaico_ingest.store.layout import encoded

__all__ = ["MARKER", "Bucket", "Heartbeat"]

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
