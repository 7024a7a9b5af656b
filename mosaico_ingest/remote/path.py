"""This file is a path behind a URL, with the part of `pathlib.Path` that recordings and stores need."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from stat import S_IFDIR, S_IFREG
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import unquote, urlsplit

from mosaico_ingest.errors import IngestError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.faults import reaching
from mosaico_ingest.remote.filesystem import SCHEMES, filesystem

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow.fs import FileInfo, FileSystem

__all__ = ["AnyPath", "RemotePath", "RemoteStat", "as_path", "is_url", "without_options"]

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/(?=[^/])|([A-Za-z][A-Za-z0-9+.-]+)://")
"""With one slash too: that is what is left of a URL that went through `Path`."""


@frozen
class RemoteStat:
    """What is known of an object without reading it; named as in `os.stat_result`."""

    st_mode: int
    st_size: int
    st_mtime_ns: int

    @property
    def st_mtime(self) -> float:
        """When it was written, in seconds since the epoch."""
        return self.st_mtime_ns / 1e9


@dataclass(frozen=True, slots=True, order=True)
class RemotePath:
    """`s3://bucket/a/b?region=…`, as root, key and options; what a listing said of it is kept with it."""

    root: str
    key: str
    options: str = field(default="", repr=False)
    listed: RemoteStat | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        """Return the URL without its options."""
        return f"{self.root}/{self.key}".rstrip("/")

    def __truediv__(self, name: str) -> RemotePath:
        """Return what lies below."""
        return replace(self, key="/".join(part for part in (self.key, name.strip("/")) if part), listed=None)

    @property
    def url(self) -> str:
        """The URL with its options, from which `as_path` makes the same path."""
        return f"{self}?{self.options}" if self.options else str(self)

    @property
    def name(self) -> str:
        """The last part."""
        return self.key.rpartition("/")[2] or self.root.rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """What follows the last dot of the name, with it."""
        return Path(self.name).suffix

    @property
    def parent(self) -> RemotePath:
        """The folder it lies in; a bucket is its own."""
        return replace(self, key=self.key.rpartition("/")[0], listed=None)

    @property
    def filesystem(self) -> FileSystem:
        """What serves it."""
        return filesystem(self.root, self.options)

    @property
    def place(self) -> str:
        """How its file system spells it."""
        return f"{self.root.partition('://')[2]}/{self.key}".rstrip("/")

    @property
    def above(self) -> Iterator[RemotePath]:
        """The folders it lies in, up to the bucket."""
        path = self
        while path.key:
            path = path.parent
            yield path

    def resolve(self) -> RemotePath:
        """Return the path itself: there are no links."""
        return self

    def exists(self) -> bool:
        """Say whether there is such an object, or one below it."""
        return self._look() is not None

    def is_file(self) -> bool:
        """Say whether it is an object."""
        found = self._look()
        return found is not None and found.st_mode & S_IFREG == S_IFREG

    def is_dir(self) -> bool:
        """Say whether there are objects below it."""
        found = self._look()
        return found is not None and found.st_mode & S_IFREG != S_IFREG

    def stat(self) -> RemoteStat:
        """Return what the listing said that it came from, or what its file system says now.

        Raises:
            FileNotFoundError: There is none.
        """
        found = self._look()
        if found is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return found

    def now(self) -> RemotePath:
        """Return the path without what a listing said of it, so that its file system is asked again."""
        return replace(self, listed=None)

    def iterdir(self) -> Iterator[RemotePath]:
        """Yield what lies in this folder, nothing where it is not there."""
        return self.listing(recursive=False)

    def listing(self, *, recursive: bool) -> Iterator[RemotePath]:
        """Yield what lies below, in the order of the names."""
        from pyarrow.fs import FileSelector  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

        selector = FileSelector(self.place, allow_not_found=True, recursive=recursive)
        with reaching(str(self)):
            found = self.filesystem.get_file_info(selector)
        bucket = self.root.partition("://")[2]
        for info in sorted(found, key=lambda one: one.path):
            yield replace(self, key=info.path.removeprefix(f"{bucket}/"), listed=_stat(info))

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """Yield what matches, as `Path.glob`: `*` within a part of the name, `**` across parts."""
        first, _, rest = pattern.strip("/").partition("/")
        if first == "**":
            folders = [self, *(one for one in self.listing(recursive=True) if one.is_dir())]
            seen = (match for folder in folders for match in folder.glob(rest or "*"))
            yield from dict.fromkeys(seen)
            return
        for entry in self.iterdir():
            if fnmatchcase(entry.name, first):
                if not rest:
                    yield entry
                elif entry.is_dir():
                    yield from entry.glob(rest)

    def open(self, mode: str = "rb") -> Any:  # noqa: ANN401 - a file of pyarrow's, whose stubs have no common class
        """Open for reading from the start to the end (`rb`).

        Raises:
            FileNotFoundError: There is none.
        """
        if mode != "rb":
            raise ValueError(f"a file behind a URL is opened with 'rb', not {mode!r}")
        with reaching(str(self)):
            return self.filesystem.open_input_stream(self.place, compression=None)

    def open_input(self) -> pa.NativeFile:
        """Open for reading by position."""
        with reaching(str(self)):
            return self.filesystem.open_input_file(self.place)

    def open_output(self) -> pa.NativeFile:
        """Open for writing; what is written is there once the file is closed."""
        with reaching(str(self)):
            return self.filesystem.open_output_stream(self.place, compression=None)

    def version(self, file: pa.NativeFile | None = None) -> str:
        """Return what changes when the object does: its size, and its tag or else the time it was written.

        Raises:
            FileNotFoundError: There is none.
        """
        with reaching(str(self)):
            opened = file or self.open_input()
            said = {str(name).lower(): bytes(value).decode() for name, value in opened.metadata().items()}
            tag = next((said[name] for name in ("etag", "generation") if said.get(name)), None)
            return f"{opened.size()} {tag or self.now().stat().st_mtime_ns}"

    def read_bytes(self) -> bytes:
        """Return the whole content."""
        with reaching(str(self)), self.open() as file:
            return bytes(file.read())

    def write_bytes(self, content: bytes) -> None:
        """Write the whole content, at once."""
        with reaching(str(self)), self.open_output() as file:
            file.write(content)

    def unlink(self) -> None:
        """Remove the object.

        Raises:
            FileNotFoundError: There is none.
        """
        with reaching(str(self)):
            self.filesystem.delete_file(self.place)

    def _look(self) -> RemoteStat | None:
        if self.listed is not None:
            return self.listed
        with reaching(str(self)):
            return _stat(self.filesystem.get_file_info(self.place))


AnyPath: TypeAlias = "Path | RemotePath"


def is_url(text: str) -> bool:
    """Say whether a text is a URL, and no path of a disk."""
    return _URL.match(text) is not None


def without_options(text: str) -> str:
    """Return a URL without what stands behind `?`; a path as it is."""
    return text.partition("?")[0] if is_url(text) else text


def as_path(given: str | Path | RemotePath) -> AnyPath:
    """Return what a text stands for: a path, or what lies behind a URL; `file://` is a path.

    Raises:
        IngestError: The URL's scheme is not known, it has no bucket, or it carries a password.
    """
    if isinstance(given, RemotePath) or not is_url(str(given)):
        return Path(given) if isinstance(given, str) else given
    text = str(given)
    if "://" not in text:  # it went through `Path`
        text = text.replace(":/", ":///" if text.startswith("file:") else "://", 1)
    try:
        url = urlsplit(text, allow_fragments=False)  # an object's name may have a #
    except ValueError as error:
        raise IngestError(f"the URL cannot be read: {error}", where=str(given)) from error
    if url.scheme == "file":
        return Path(unquote(url.path))
    if url.scheme not in SCHEMES:
        known = ", ".join(f"{scheme}://" for scheme in (*SCHEMES, "file"))
        raise IngestError(
            f"the scheme {url.scheme}:// is not known", where=str(given), hint=f"known are {known}"
        )
    if not url.netloc:
        raise IngestError("the URL names no bucket", where=str(given))
    if "@" in url.netloc:
        raise IngestError(
            "a URL is no place for a password",
            where=f"{url.scheme}://…@{url.netloc.rpartition('@')[2]}",
            hint="credentials are taken from the environment, the client's configuration or the machine's role",
        )
    return RemotePath(f"{url.scheme}://{url.netloc}", url.path.strip("/"), url.query)


def _stat(info: FileInfo) -> RemoteStat | None:
    from pyarrow.fs import FileType  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    if info.type == FileType.NotFound:
        return None
    mode = S_IFREG if info.type == FileType.File else S_IFDIR
    return RemoteStat(mode, info.size or 0, info.mtime_ns or 0)
