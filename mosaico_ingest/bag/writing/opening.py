"""This file chooses a container by a file's name, and puts the file in place when it is whole."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from mosaico_ingest.bag.writing.mcap import McapWriter
from mosaico_ingest.bag.writing.rosbags import Ros1Writer, SqliteWriter
from mosaico_ingest.bag.writing.writer import RecordingWriter
from mosaico_ingest.errors import BagError

__all__ = ["ROS_VERSIONS", "open_writer"]

ROS_VERSIONS = {".mcap": (1, 2), ".db3": (2,), ".bag": (1,)}
"""By suffix: the versions of ROS whose messages the container holds."""

_WRITERS: dict[str, Callable[[Path], RecordingWriter]] = {
    ".mcap": McapWriter,
    ".db3": SqliteWriter,
    ".bag": Ros1Writer,
}


@contextmanager
def open_writer(path: Path, *, replace: bool = False) -> Generator[RecordingWriter]:
    """Open a writer for `.mcap`, `.db3` or `.bag`; an exception leaves no file behind.

    Raises:
        BagError: The name says no container, the file is there already, or it cannot be written.
    """
    make = _WRITERS.get(path.suffix)
    if make is None:
        raise BagError("no container has this suffix", where=str(path), hint="write .mcap, .db3 or .bag")
    if path.exists() and not replace:
        raise BagError("is there already", where=str(path), hint="choose another name, or give --force")
    if path.is_dir():
        raise BagError("is a folder", where=str(path), hint="choose another name")
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{path.stem}-", dir=path.parent))
    except OSError as error:
        raise BagError(f"cannot be written: {error.strerror}", where=str(path)) from error
    try:
        part = folder / path.name
        writer = make(part)
        try:
            yield writer
            writer.finish()
        except BaseException:
            writer.abandon()
            raise
        part.replace(path)
    except (OSError, sqlite3.Error) as error:
        raise BagError(f"cannot be written: {error}", where=str(path)) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
