"""This file opens a file of a recording by what it holds, whatever its name."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from stat import S_ISREG

from mosaico_ingest.bag.containers import mcap, ros1, sqlite
from mosaico_ingest.bag.containers.compression import ZSTD_MAGIC, inflate_file
from mosaico_ingest.bag.containers.part import Hole, Part
from mosaico_ingest.errors import BagError

__all__ = ["is_recording", "open_part"]

_FORMATS: tuple[tuple[bytes, Callable[[Path, Path], Part]], ...] = (
    (mcap.MAGIC, mcap.McapPart),
    (sqlite.MAGIC, sqlite.SqlitePart),
    (ros1.MAGIC, ros1.Ros1Part),
)
_LOOK_BYTES = 16


def is_recording(path: Path) -> bool:
    """Return whether the file begins as a recording, or as a zstd file that may hold one."""
    head = _head(path)
    return head.startswith((ZSTD_MAGIC, *(magic for magic, _ in _FORMATS)))


def open_part(path: Path, stack: ExitStack) -> Part:
    """Open a file; `stack` closes it, and removes what a compressed one was inflated to.

    Raises:
        BagError: It is empty, no recording, or damaged beyond reading.
    """
    head = _head(path)
    if not head.startswith(ZSTD_MAGIC):
        return _open(path, path, head, stack)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))
    plain = folder / path.name.removesuffix(".zstd")
    try:
        problem = inflate_file(path, plain)
    except OSError as err:
        raise BagError(
            f"cannot be decompressed to {folder}: {err.strerror}",
            where=str(path),
            hint="decompress it yourself, or point TMPDIR at a larger disk",
        ) from err
    part = _open(plain, path, _head(plain), stack)
    if problem:
        part.holes.append(Hole(plain.stat().st_size, problem))
    return part


def _head(path: Path) -> bytes:
    try:
        if not S_ISREG(path.stat().st_mode):  # to open a pipe waits for its writer
            raise BagError("a pipe, a socket or a device, not a file", where=str(path))
        with path.open("rb") as file:
            return file.read(_LOOK_BYTES)
    except OSError as err:
        raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err


def _open(path: Path, name: Path, head: bytes, stack: ExitStack) -> Part:
    for magic, kind in _FORMATS:
        if head.startswith(magic):
            try:
                part = kind(path, name)
            except BagError as err:
                raise err if err.where else BagError(err.what, where=str(name), hint=err.hint) from err
            stack.callback(part.close)
            return part
    if not head:
        raise BagError("the file is empty", where=str(name), hint="record again, or remove it from the job")
    raise BagError(
        f"not a recording; it begins with {head.hex(' ')}",
        where=str(name),
        hint="ROS 1 .bag, rosbag2 .db3 and .mcap are read, each also as .zstd",
    )
