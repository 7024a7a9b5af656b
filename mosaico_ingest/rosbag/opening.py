"""Open one file of a recording: detect its format by content, download and decompress it if necessary."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from stat import S_ISREG

from mosaico_ingest.containers import SUFFIX_LIST, ZSTD, ZSTD_SUFFIX, Container, container_of
from mosaico_ingest.errors import BagError
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import SplitReader, UnreadableRange
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES, decompress_file
from mosaico_ingest.rosbag.source import CachedSource, FileSource, RemoteSource, download

_HEAD_BYTES = 16


def is_recording(path: AnyPath) -> bool:
    """Return whether the file starts with the magic of a container, or of zstd."""
    head = _read_head(path)
    return head.startswith(ZSTD) or container_of(head) is not None


def open_split(path: AnyPath, stack: ExitStack, *, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> SplitReader:
    """Open a file; `stack` closes it and removes temporary copies.

    Chunks whose decompressed size exceeds `max_chunk_bytes` are not read.

    Raises:
        BagError: The file is empty, not a recording, or damaged beyond reading.
        Unreachable: The server of a remote file does not respond.
    """
    if isinstance(path, RemotePath):
        return _open_remote(path, stack, max_chunk_bytes)
    head = _read_head(path)
    if head.startswith(ZSTD):
        return _open_compressed(path, path, stack, max_chunk_bytes)
    return _open_local(path, path, head, stack, max_chunk_bytes)


def _open_remote(path: RemotePath, stack: ExitStack, max_chunk_bytes: int) -> SplitReader:
    """Open a remote file in place; download it if it cannot be read by range."""
    source = RemoteSource(path)
    head = source.read_some(0, _HEAD_BYTES)
    container = container_of(head)
    if container is not None and container.by_offset and source.has_ranges:
        return _opened(container, path, stack, source, max_chunk_bytes)
    logs = [log for log in _log_paths(path) if log.is_file()]
    reason = _download_reason(source, container, logs)
    if container is not None and reason is None:
        return _opened(container, path, stack, CachedSource(source))
    source.close()
    if container is None and not head.startswith(ZSTD):
        raise _not_a_recording(head, path)
    folder = _temporary_folder(stack)
    copy = download(path, folder)
    if head.startswith(ZSTD):
        split = _open_compressed(copy, path, stack, max_chunk_bytes)
        copy.unlink()
    else:
        for log in logs:
            download(log, folder)
        split = _open_local(copy, path, head, stack, max_chunk_bytes)
    split.notes.append(f"{reason}, so all {source.size} bytes were downloaded")
    return split


def _log_paths(path: RemotePath) -> list[RemotePath]:
    """Return the paths of the logs that SQLite may have left next to a file."""
    return [] if path.is_web else [path.parent / f"{path.name}{suffix}" for suffix in ("-wal", "-journal")]


def _download_reason(source: RemoteSource, container: Container | None, logs: list[RemotePath]) -> str | None:
    """Return why a file must be downloaded, None if its pages can be read by range."""
    if container is None:
        return "it is compressed"
    if not source.has_ranges:
        return "the server ignores ranges"
    if logs:
        return f"{logs[0].name} must be replayed"
    if find_spec("apsw") is None:
        return "the extra mosaico-ingest[remote] is not installed"
    return None


def _open_compressed(path: Path, name: AnyPath, stack: ExitStack, max_chunk_bytes: int) -> SplitReader:
    folder = _temporary_folder(stack)
    plain = folder / path.name.removesuffix(ZSTD_SUFFIX)
    try:
        problem = decompress_file(path, plain)
    except OSError as err:
        raise BagError(
            f"cannot be decompressed to {folder}: {err.strerror}",
            where=str(name),
            hint="decompress it yourself, or point TMPDIR at a larger disk",
        ) from err
    head = _read_head(plain)
    if problem and container_of(head) is None:
        raise BagError(
            f"{problem} after {plain.stat().st_size} decompressed bytes",
            where=str(name),
            hint="copy the file again, or check it with `zstd --test`",
        )
    split = _open_local(plain, name, head, stack, max_chunk_bytes)
    if problem:
        split.unreadable.append(UnreadableRange(plain.stat().st_size, problem))
    return split


def _open_local(
    path: Path, name: AnyPath, head: bytes, stack: ExitStack, max_chunk_bytes: int
) -> SplitReader:
    container = container_of(head)
    if container is None:
        raise _not_a_recording(head, name)
    if container.by_offset:
        return _opened(container, name, stack, FileSource(path, name), max_chunk_bytes)
    return _opened(container, name, stack, path, name)


def _opened(container: Container, name: AnyPath, stack: ExitStack, *arguments: object) -> SplitReader:
    """Create the reader of a container; see `Container.by_offset` for its arguments."""
    reader: Callable[..., SplitReader] = resolve_name(container.reader)
    try:
        split = reader(*arguments)
    except BagError as err:
        raise err if err.where else BagError(err.what, where=str(name), hint=err.hint) from err
    stack.callback(split.close)
    return split


def _temporary_folder(stack: ExitStack) -> Path:
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))


def _read_head(path: AnyPath) -> bytes:
    try:
        if not S_ISREG(path.stat().st_mode):  # opening a pipe would block until there is a writer
            raise BagError("a pipe, a socket or a device, not a file", where=str(path))
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as err:
        raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err


def _not_a_recording(head: bytes, name: AnyPath) -> BagError:
    if not head:
        return BagError("the file is empty", where=str(name), hint="record again, or remove it from the job")
    return BagError(
        f"not a recording; the first bytes are {head.hex(' ')}",
        where=str(name),
        hint=f"supported are {SUFFIX_LIST} files, plain or compressed as {ZSTD_SUFFIX}",
    )
