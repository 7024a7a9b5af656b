"""This file opens a file of a recording by what it holds, whatever its name and wherever it lies.

Of the modules that read, only the one for what is found is imported.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from stat import S_ISREG

from mosaico_ingest.errors import BagError
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import Part, UnreadableRange
from mosaico_ingest.rosbag.compression import inflate_file
from mosaico_ingest.rosbag.formats import (
    MCAP,
    ROS1,
    ROSRECORD,
    SQLITE,
    ZSTD,
)
from mosaico_ingest.rosbag.source import FileSource, Source

__all__ = ["is_recording", "open_part"]

_LOOK_BYTES = 16


def _mcap(source: Source) -> Part:
    from mosaico_ingest.rosbag.mcap.reader import McapPart

    return McapPart(source)


def _ros1(source: Source) -> Part:
    from mosaico_ingest.rosbag.ros1.reader import Ros1Part

    return Ros1Part(source)


def _rosrecord(source: Source) -> Part:
    from mosaico_ingest.rosbag.ros1.version_1_2 import RosrecordPart

    return RosrecordPart(source)


def _sqlite(path: Path, name: AnyPath) -> Part:
    from mosaico_ingest.rosbag.sqlite import SqlitePart

    return SqlitePart(path, name)


_INDEXED: Mapping[bytes, Callable[[Source], Part]] = {MCAP: _mcap, ROSRECORD: _rosrecord, ROS1: _ros1}
"""What is read by position, and so also behind a URL, without reading all of it; the first that fits is taken."""
_MAGICS = (ZSTD, SQLITE, *_INDEXED)


def is_recording(path: AnyPath) -> bool:
    """Return whether the file begins as a recording, or as a zstd file that may hold one."""
    return _head(path).startswith(_MAGICS)


def open_part(path: AnyPath, stack: ExitStack) -> Part:
    """Open a file; `stack` closes it, and removes what had to be fetched or inflated.

    Raises:
        BagError: It is empty, no recording, or damaged beyond reading.
        Unreachable: It lies behind a URL that does not answer.
    """
    if isinstance(path, RemotePath):
        return _open_remote(path, stack)
    head = _head(path)
    if not head.startswith(ZSTD):
        return _open(path, path, head, stack)
    return _inflated(path, path, stack)


def _open_remote(path: RemotePath, stack: ExitStack) -> Part:
    """Open an object in place, or fetch it where it can only be read as a whole."""
    from mosaico_ingest.rosbag.source import RemoteSource, fetch

    source = RemoteSource(path)
    head = source.read_some(0, _LOOK_BYTES)
    for magic, kind in _INDEXED.items():
        if head.startswith(magic):
            return _entered(partial(kind, source), path, stack)
    source.close()
    if not head.startswith((ZSTD, SQLITE)):
        raise _no_recording(head, path)
    folder = _folder(stack)
    near = fetch(path, folder)
    if head.startswith(ZSTD):
        part = _inflated(near, path, stack)
        near.unlink()
    else:
        for beside in (path.parent / f"{path.name}{suffix}" for suffix in ("-wal", "-journal")):
            if beside.is_file():
                fetch(beside, folder)
        part = _open(near, path, head, stack)
    part.notes.append(f"it can only be read as a whole, so all of its {source.size} bytes were fetched first")
    return part


def _inflated(path: Path, name: AnyPath, stack: ExitStack) -> Part:
    folder = _folder(stack)
    plain = folder / path.name.removesuffix(".zstd")
    try:
        problem = inflate_file(path, plain)
    except OSError as err:
        raise BagError(
            f"cannot be decompressed to {folder}: {err.strerror}",
            where=str(name),
            hint="decompress it yourself, or point TMPDIR at a larger disk",
        ) from err
    part = _open(plain, name, _head(plain), stack)
    if problem:
        part.unreadable.append(UnreadableRange(plain.stat().st_size, problem))
    return part


def _folder(stack: ExitStack) -> Path:
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))


def _head(path: AnyPath) -> bytes:
    try:
        if not S_ISREG(path.stat().st_mode):  # to open a pipe waits for its writer
            raise BagError("a pipe, a socket or a device, not a file", where=str(path))
        with path.open("rb") as file:
            return file.read(_LOOK_BYTES)
    except OSError as err:
        raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err


def _open(path: Path, name: AnyPath, head: bytes, stack: ExitStack) -> Part:
    for magic, kind in _INDEXED.items():
        if head.startswith(magic):
            return _entered(partial(kind, FileSource(path, name)), name, stack)
    if head.startswith(SQLITE):
        return _entered(partial(_sqlite, path, name), name, stack)
    raise _no_recording(head, name)


def _entered(make: Callable[[], Part], name: AnyPath, stack: ExitStack) -> Part:
    try:
        part = make()
    except BagError as err:
        raise err if err.where else BagError(err.what, where=str(name), hint=err.hint) from err
    stack.callback(part.close)
    return part


def _no_recording(head: bytes, name: AnyPath) -> BagError:
    if not head:
        return BagError("the file is empty", where=str(name), hint="record again, or remove it from the job")
    return BagError(
        f"not a recording; it begins with {head.hex(' ')}",
        where=str(name),
        hint="ROS 1 .bag, rosbag2 .db3 and .mcap are read, each also as .zstd",
    )
