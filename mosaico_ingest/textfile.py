"""This file reads whole files, never from a pipe and never without end, and writes text files whole or not at all."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path
from stat import S_ISDIR, S_ISREG

from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.remote import AnyPath

__all__ = ["LONGEST", "check_file", "read_whole", "write_whole"]

LONGEST = 64 * 1024 * 1024
"""Bytes of the longest text that is read."""


def read_whole(path: AnyPath) -> bytes:
    """Return what a file holds.

    Raises:
        OSError: It cannot be read, is no file (to open a pipe would wait for its writer), or is longer than `LONGEST`.
    """
    about = path.stat()
    if not S_ISREG(about.st_mode) and not S_ISDIR(about.st_mode):
        raise OSError(errno.EINVAL, "a pipe, a socket or a device, not a file", str(path))
    with path.open("rb") as file:
        content = file.read(LONGEST + 1)
    if len(content) > LONGEST:
        raise OSError(errno.EFBIG, f"longer than {LONGEST >> 20} MiB", str(path))
    return content


def check_file(path: Path) -> None:
    """Refuse what cannot be a file to write, before there is anything to write.

    Raises:
        ManifestError: It is a folder.
    """
    if path.is_dir():
        raise ManifestError("is a folder", where=str(path), hint="name a file")


def write_whole(path: Path, text: str) -> None:
    """Write a text file, and its folder where there is none; what was there stays until all of it is written.

    Raises:
        ManifestError: It is a folder.
        SinkError: The file cannot be written.
    """
    check_file(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise SinkError(f"cannot be written: {error.strerror}", where=str(path)) from error
