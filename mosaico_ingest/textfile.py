"""This file reads the files that a job names: whole, but never from a pipe and never without end."""

from __future__ import annotations

import errno
from stat import S_ISDIR, S_ISREG

from mosaico_ingest.remote.path import AnyPath

__all__ = ["LONGEST", "read_whole"]

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
