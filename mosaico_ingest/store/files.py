"""This file opens segments, on a disk or behind a URL."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from mosaico_ingest.remote.path import AnyPath, RemotePath
from mosaico_ingest.store import layout

__all__ = ["create", "footer", "opened", "send_ahead", "settle"]


def create(path: AnyPath) -> pa.NativeFile:
    """Open a new file for writing; behind a URL it is sent while it is written, and there once it is closed."""
    return path.open_output() if isinstance(path, RemotePath) else pa.OSFile(str(path), "wb")


def send_ahead(file: pa.NativeFile, begin: int, end: int) -> None:
    """Have the system begin to bring a stretch of a file to the disk, so that `settle` waits for less; on Linux it does."""
    if isinstance(file, pa.OSFile) and hasattr(os, "posix_fadvise"):
        # Linux writes dirty pages when it is told that they are not needed, without anyone waiting for it. It is a
        # hint: a file system that takes none is no reason to stop, and a disk that fails says so to `settle`.
        with suppress(OSError):
            os.posix_fadvise(file.fileno(), begin, end - begin, os.POSIX_FADV_DONTNEED)


def settle(path: AnyPath) -> None:
    """Wait until a closed file is there to stay; a store behind a URL has said so already."""
    if not isinstance(path, RemotePath):
        layout.fsync(path)


def opened(path: AnyPath, **options: Any) -> pq.ParquetFile:  # noqa: ANN401 - those of `pq.ParquetFile`
    """Open a Parquet file for reading; behind a URL the column chunks of a row group are asked for together."""
    if isinstance(path, RemotePath):
        return pq.ParquetFile(path.open_input(), pre_buffer=True, **options)
    return pq.ParquetFile(path, **options)


def footer(path: AnyPath) -> pq.FileMetaData:
    """Return what a Parquet file says of itself."""
    with opened(path) as file:
        return file.metadata
