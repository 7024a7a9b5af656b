"""Reading of regular files up to a maximum size, and atomic writing of text files."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from stat import S_ISDIR, S_ISREG

from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.remote import AnyPath

MAX_FILE_BYTES = 64 * 1024 * 1024
"""Maximum size of a manifest, definition, plan or report that is read, in bytes."""


def read_limited(path: AnyPath) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: The file cannot be read, is a pipe or a device (which could block), or is larger than `MAX_FILE_BYTES`.
    """
    mode = path.stat().st_mode
    if not S_ISREG(mode) and not S_ISDIR(mode):
        raise OSError(errno.EINVAL, "a pipe, a socket or a device, not a file", str(path))
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise OSError(errno.EFBIG, f"longer than {MAX_FILE_BYTES >> 20} MiB", str(path))
    return content


def check_output_file(path: Path) -> None:
    """Raise if a path cannot be an output file, before there is output.

    Raises:
        ManifestError: The path is a folder.
    """
    if path.is_dir():
        raise ManifestError("is a folder", where=str(path), hint="name a file")


def write_atomically(path: Path, text: str | Iterable[str]) -> None:
    """Write a text file and create its folder; an existing file stays until the new one is complete.

    The text may come in parts, which are written one after the other.

    Raises:
        ManifestError: The path is a folder.
        SinkError: The file cannot be written.
    """
    check_output_file(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("w", encoding="utf-8") as file:
            file.writelines([text] if isinstance(text, str) else text)
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise SinkError(f"cannot be written: {error.strerror}", where=str(path)) from error
