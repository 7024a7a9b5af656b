"""Paths behind URLs: a subset of `pathlib.Path` over pyarrow file systems, and their errors.

pyarrow's file systems need no additional dependency, its Parquet reader and writer use them without a Python layer, and
they read the credentials files of AWS, which obstore does not. CONTRIBUTING.md has figures for obstore and fsspec.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import lru_cache, partial
from pathlib import Path
from stat import S_IFDIR, S_IFREG
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import parse_qs, unquote, urlsplit

from msgspec import Struct

from mosaico_ingest.errors import IngestError, Unreachable

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow.fs import FileInfo, FileSystem

    from mosaico_ingest.web_files import Properties

_REFUSED = re.compile(
    r"ACCESS_DENIED|INVALID_ACCESS_KEY|INVALID_SIGNATURE|INVALID_CLIENT_TOKEN|SIGNATURE_DOES_NOT_MATCH"
    r"|MISSING_AUTHENTICATION|EXPIRED_TOKEN|HTTP status 40[13]|PERMISSION_DENIED|UNAUTHENTICATED|PermissionDenied"
)
_TRANSIENT = re.compile(
    r"NETWORK_CONNECTION|SLOW_DOWN|THROTTLING|SERVICE_UNAVAILABLE|INTERNAL_FAILURE|REQUEST_TIMEOUT|REQUEST_EXPIRED"
    r"|HTTP status 5\d\d|curlCode|\bUNAVAILABLE\b|DEADLINE_EXCEEDED|Retry policy exhausted|[Tt]imed out"
)
_NO_BUCKET = re.compile(r"NO_SUCH_BUCKET|[Bb]ucket .*(does not exist|not found)")
_SDK = re.compile(r"^.*?AWS Error |\s*\(Request ID: [^)]*\)")


@contextmanager
def translate_errors(where: str) -> Generator[None, None, None]:
    """Raise IngestError for errors of a file system; a missing object remains a FileNotFoundError.

    Raises:
        Unreachable: The service did not respond in time, after several attempts.
        IngestError: Access is refused, or the request is invalid.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as err:
        raise as_ingest_error(err, where) from err


def as_ingest_error(err: OSError, where: str) -> IngestError:
    """Return the IngestError for an error of a file system at `where`."""
    message = _SDK.sub("", str(err).strip().splitlines()[0] if str(err).strip() else type(err).__name__)
    if is_transient(err):
        return Unreachable(
            f"does not respond: {message}", where=where, hint="check the address and the network"
        )
    if _REFUSED.search(str(err)):
        hint = "check the credentials: the environment, the client's configuration, or the machine's role"
        return IngestError(f"access is refused: {message}", where=where, hint=hint)
    if _NO_BUCKET.search(str(err)):
        return IngestError(
            "the bucket does not exist", where=where, hint="check the URL; buckets are not created"
        )
    return IngestError(message, where=where)


def is_transient(err: OSError) -> bool:
    """Return whether a later retry may succeed."""
    return isinstance(err, ConnectionError | TimeoutError) or _TRANSIENT.search(str(err)) is not None


class Network(Struct, frozen=True):
    """Timeouts and attempts of requests, and the maximum size of a download."""

    attempts: int = 5
    """Maximum number of attempts per request, with a delay that doubles; GCS repeats for `request_s` seconds instead."""
    connect_s: float = 5.0
    """Timeout of a connection, in seconds."""
    request_s: float = 30.0
    """Timeout of a request, in seconds."""
    max_download_bytes: int | None = None
    """Maximum size of a recording that must be downloaded completely; None for no limit."""


def filesystem(root: str, options: str, network: Network = Network()) -> FileSystem:  # noqa: B008 - immutable
    """Return the file system of a root such as `s3://bucket`, cached per process and options.

    Raises:
        IngestError: The scheme or an option is unknown.
        Unreachable: The region of the bucket cannot be determined.
    """
    return _cached_filesystem(root, options, network, os.getpid())  # a connection must not cross a fork


@lru_cache(maxsize=64)
def _cached_filesystem(root: str, options: str, network: Network, _process: int) -> FileSystem:
    scheme, _, bucket = root.partition("://")
    if scheme in WEB_SCHEMES:
        return _web(root, options, network)
    create, option_names = SCHEMES[scheme]
    return create(bucket, _options(root, options, option_names), network)


def _web(root: str, query: str, network: Network) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    from mosaico_ingest.web_files import WebFiles  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    return fs.PyFileSystem(WebFiles(root, query, network))


def _options(root: str, options: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return the options of a URL. The error never contains their values, because they may be secret."""
    values = {name: values[-1] for name, values in parse_qs(options, keep_blank_values=True).items()}
    for name in values:
        if name not in names:
            raise IngestError(
                f"unknown URL option {name!r}", where=root, hint=f"the options are {', '.join(names)}"
            )
    return values


def _s3(bucket: str, options: dict[str, str], network: Network) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    region = options.get("region")
    if region is None and "endpoint_override" not in options:
        with translate_errors(f"s3://{bucket}"):
            region = fs.resolve_s3_region(bucket)
    return fs.S3FileSystem(
        region=region,
        scheme=options.get("scheme", "https"),
        endpoint_override=options.get("endpoint_override"),
        anonymous=options.get("anonymous") == "true",
        connect_timeout=network.connect_s,
        request_timeout=network.request_s,
        retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=network.attempts),
        allow_delayed_open=True,  # pyright: ignore[reportCallIssue] - the stubs are older; the option sends small objects in one request
    )


def _gs(_bucket: str, options: dict[str, str], network: Network) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    return fs.GcsFileSystem(
        anonymous=options.get("anonymous") == "true",
        scheme=options.get("scheme", "https"),
        endpoint_override=options.get("endpoint_override"),
        retry_time_limit=timedelta(seconds=network.request_s),
    )


def _az(container: str, options: dict[str, str], network: Network) -> FileSystem:
    from pyarrow import fs  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    try:
        from mosaico_ingest.azure_files import AzureFiles  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise IngestError(
            "obstore is not installed",
            where=f"az://{container}",
            hint="pip install 'mosaico-ingest[azure]'",
        ) from error
    return fs.PyFileSystem(AzureFiles(container, options, network))


_Factory = Callable[[str, "dict[str, str]", Network], "FileSystem"]
SCHEMES: dict[str, tuple[_Factory, tuple[str, ...]]] = {
    "s3": (_s3, ("endpoint_override", "scheme", "region", "anonymous")),
    "gs": (_gs, ("endpoint_override", "scheme", "anonymous")),
    "az": (_az, ("account_name", "endpoint_override", "scheme")),
}
"""The supported schemes of object stores, with the options that are allowed after `?`."""
WEB_SCHEMES = ("https", "http")
"""The schemes of web servers, which cannot be listed or written; the text after `?` is part of the URL."""

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/(?=[^/])|([A-Za-z][A-Za-z0-9+.-]+)://")
"""A URL; one slash is accepted too, because `Path` merges the two slashes of a URL."""


class RemoteStat(Struct, frozen=True):
    """The properties of an object, named as in `os.stat_result`."""

    st_mode: int
    st_size: int
    st_mtime_ns: int

    @property
    def st_mtime(self) -> float:
        """Modification time in seconds since the epoch."""
        return self.st_mtime_ns / 1e9


@dataclass(frozen=True, slots=True, order=True)
class RemotePath:
    """A path such as `s3://bucket/a/b?region=…`, as root, key and options, with the properties from a listing."""

    root: str
    key: str
    options: str = field(default="", repr=False)
    listed: RemoteStat | None = field(default=None, compare=False, repr=False)
    network: Network = field(default=Network(), compare=False, repr=False)

    def __str__(self) -> str:
        """Return the URL without its options."""
        return f"{self.root}/{self.key}".rstrip("/")

    def __truediv__(self, name: str) -> RemotePath:
        """Return the path of an entry of this folder."""
        return replace(self, key="/".join(part for part in (self.key, name.strip("/")) if part), listed=None)

    @property
    def url(self) -> str:
        """The URL with its options; `as_path` converts it back to the same path."""
        return f"{self}?{self.options}" if self.options else str(self)

    @property
    def name(self) -> str:
        """The last component of the path, or the bucket."""
        return self.key.rpartition("/")[2] or self.root.rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """The file extension of the name, with its dot."""
        return Path(self.name).suffix

    @property
    def parent(self) -> RemotePath:
        """The parent folder; a bucket is its own parent."""
        return replace(self, key=self.key.rpartition("/")[0], listed=None)

    @property
    def is_web(self) -> bool:
        """Whether the path is a file of a web server, which has no folders."""
        return self.root.partition("://")[0] in WEB_SCHEMES

    @property
    def filesystem(self) -> FileSystem:
        """The file system of the path."""
        return filesystem(self.root, self.options, self.network)

    @property
    def filesystem_path(self) -> str:
        """The path within its file system."""
        return f"{self.root.partition('://')[2]}/{self.key}".rstrip("/")

    @property
    def above(self) -> Iterator[RemotePath]:
        """The parent folders, up to the bucket."""
        path = self
        while path.key:
            path = path.parent
            yield path

    def resolve(self) -> RemotePath:
        """Return the path itself, because object stores have no links."""
        return self

    def exists(self) -> bool:
        """Return whether the object, or an object below it, exists."""
        return self._stat_or_none() is not None

    def is_file(self) -> bool:
        """Return whether the path is an object."""
        stat = self._stat_or_none()
        return stat is not None and stat.st_mode & S_IFREG == S_IFREG

    def is_dir(self) -> bool:
        """Return whether the path is a folder: objects exist below it."""
        stat = self._stat_or_none()
        return stat is not None and stat.st_mode & S_IFREG != S_IFREG

    def stat(self) -> RemoteStat:
        """Return the properties from the listing that produced the path, or the current ones.

        Raises:
            FileNotFoundError: The object does not exist.
        """
        stat = self._stat_or_none()
        if stat is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return stat

    def now(self) -> RemotePath:
        """Return the path without the properties from a listing, so that they are requested again."""
        return replace(self, listed=None)

    def iterdir(self) -> Iterator[RemotePath]:
        """Yield the entries of this folder, sorted by path; a missing folder has no entries."""
        return self.listing(recursive=False)

    def listing(self, *, recursive: bool) -> Iterator[RemotePath]:
        """Yield the entries of this folder, with `recursive` also those of its subfolders, sorted by path."""
        from pyarrow.fs import FileSelector  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

        selector = FileSelector(self.filesystem_path, allow_not_found=True, recursive=recursive)
        with translate_errors(str(self)):
            infos = self.filesystem.get_file_info(selector)
        bucket = self.root.partition("://")[2]
        for info in sorted(infos, key=lambda info: info.path):
            yield replace(self, key=info.path.removeprefix(f"{bucket}/"), listed=_stat(info))

    def glob(self, pattern: str) -> Iterator[RemotePath]:
        """Yield the matching paths, as `Path.glob`: `*` matches within a component, `**` across components."""
        first, _, rest = pattern.strip("/").partition("/")
        if first == "**":
            folders = [self, *(entry for entry in self.listing(recursive=True) if entry.is_dir())]
            matches = (match for folder in folders for match in folder.glob(rest or "*"))
            yield from dict.fromkeys(matches)
            return
        for entry in self.iterdir():
            if fnmatchcase(entry.name, first):
                if not rest:
                    yield entry
                elif entry.is_dir():
                    yield from entry.glob(rest)

    def open(self, mode: str = "rb") -> Any:  # noqa: ANN401 - a file of pyarrow, whose stubs have no common class
        """Open the object for sequential reading; the only mode is `rb`.

        Raises:
            FileNotFoundError: The object does not exist.
        """
        if mode != "rb":
            raise ValueError(f"mode {mode!r} is not supported for URLs; use 'rb'")
        with translate_errors(str(self)):
            return self.filesystem.open_input_stream(self.filesystem_path, compression=None)

    def open_input(self) -> pa.NativeFile:
        """Open the object for random access."""
        with translate_errors(str(self)):
            return self.filesystem.open_input_file(self.filesystem_path)

    def open_output(self) -> pa.NativeFile:
        """Open the object for writing; it becomes visible when the file is closed."""
        with translate_errors(str(self)):
            return self.filesystem.open_output_stream(self.filesystem_path, compression=None)

    def version(self, file: pa.NativeFile | None = None) -> str:
        """Return the version of the content: its size, and its tag or modification time.

        Raises:
            FileNotFoundError: The object does not exist.
        """
        with translate_errors(str(self)):
            properties = self._properties(cached=False)
            if properties is not None:
                return f"{properties.size} {properties.version}"
            opened = file or self.open_input()
            metadata = {str(name).lower(): bytes(value).decode() for name, value in opened.metadata().items()}
            tag = next((metadata[name] for name in ("etag", "generation") if metadata.get(name)), None)
            return f"{opened.size()} {tag or self.now().stat().st_mtime_ns}"

    @property
    def has_ranges(self) -> bool:
        """Whether the server sends ranges of the file.

        Raises:
            FileNotFoundError: The file does not exist.
        """
        with translate_errors(str(self)):
            properties = self._properties(cached=True)
        return properties is None or properties.has_ranges

    def range_reader(self, file: pa.NativeFile) -> Callable[[int, int], bytes]:
        """Return a function that returns a range of the open file; several threads can call it at the same time."""
        if self._handler is None or not self.has_ranges:
            return partial(_read_at, file)
        # An open file of a file system in Python reads one range at a time.
        return partial(self._handler.read_range, self.filesystem_path)

    @property
    def _handler(self) -> Any:  # noqa: ANN401 - `WebFiles` and `AzureFiles` are imported lazily
        """The file system in Python, None for those of pyarrow itself."""
        return getattr(self.filesystem, "handler", None)

    def _properties(self, *, cached: bool) -> Properties | None:
        """Return the properties of the file, None for the file systems of pyarrow itself."""
        if self._handler is None:
            return None
        properties = self._handler.properties(self.filesystem_path, cached=cached)
        if properties is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return properties

    def read_bytes(self) -> bytes:
        """Return the content of the object."""
        with translate_errors(str(self)), self.open() as file:
            return bytes(file.read())

    def write_bytes(self, content: bytes) -> None:
        """Write the content of the object atomically."""
        with translate_errors(str(self)), self.open_output() as file:
            file.write(content)

    def unlink(self) -> None:
        """Remove the object.

        Raises:
            FileNotFoundError: The object does not exist.
        """
        with translate_errors(str(self)):
            self.filesystem.delete_file(self.filesystem_path)

    def _stat_or_none(self) -> RemoteStat | None:
        if self.listed is not None:
            return self.listed
        with translate_errors(str(self)):
            return _stat(self.filesystem.get_file_info(self.filesystem_path))


AnyPath: TypeAlias = "Path | RemotePath"


def is_url(text: str) -> bool:
    """Return whether a text is a URL."""
    return _URL.match(text) is not None


def with_network(path: AnyPath, network: Network) -> AnyPath:
    """Return a path with the timeouts and retries of its requests; local paths are returned unchanged."""
    return replace(path, network=network) if isinstance(path, RemotePath) else path


def without_options(text: str) -> str:
    """Return a URL without its options; other text is returned unchanged."""
    return text.partition("?")[0] if is_url(text) else text


def as_path(location: str | Path | RemotePath) -> AnyPath:
    """Return the local or remote path of a text; `file://` URLs are local paths.

    Raises:
        IngestError: The URL has an unknown scheme, no bucket, or a password.
    """
    if isinstance(location, RemotePath) or not is_url(str(location)):
        return Path(location) if isinstance(location, str) else location
    text = str(location)
    if "://" not in text:  # `Path` has merged the slashes
        text = text.replace(":/", ":///" if text.startswith("file:") else "://", 1)
    try:
        url = urlsplit(text, allow_fragments=False)  # names of objects may contain #
    except ValueError as error:
        raise IngestError(f"the URL is invalid: {error}", where=without_options(text)) from error
    if url.scheme == "file":
        return Path(unquote(url.path))
    where = without_options(text)
    if url.scheme not in SCHEMES and url.scheme not in WEB_SCHEMES:
        schemes = ", ".join(f"{scheme}://" for scheme in (*SCHEMES, *WEB_SCHEMES, "file"))
        raise IngestError(f"unknown URL scheme {url.scheme}://", where=where, hint=f"use one of {schemes}")
    if not url.netloc:
        raise IngestError("the URL has no bucket", where=where, hint=f"write {url.scheme}://BUCKET/PATH")
    if "@" in url.netloc:
        raise IngestError(
            "the URL contains credentials",
            where=f"{url.scheme}://…@{url.netloc.rpartition('@')[2]}",
            hint="remove them; set credentials in the environment, the client's configuration or the machine's role",
        )
    return RemotePath(f"{url.scheme}://{url.netloc}", url.path.strip("/"), url.query)


_ONE_SLASH = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/(?!/)")


def parse_url(text: str) -> AnyPath:
    """Return the path of a URL in a manifest; in contrast to `as_path`, check the slashes and the options.

    Raises:
        IngestError: The URL has one slash after its scheme, an unknown scheme or option, no bucket, or a password.
    """
    if _ONE_SLASH.match(text):
        raise IngestError(
            "the URL has one slash after its scheme", where=text, hint=f"write {text.replace(':/', '://', 1)}"
        )
    path = as_path(text)
    if isinstance(path, RemotePath) and not path.is_web:
        _options(path.root, path.options, SCHEMES[path.root.partition("://")[0]][1])
    return path


def _read_at(file: pa.NativeFile, start: int, stop: int) -> bytes:
    return file.read_at(stop - start, start)  # pyright: ignore[reportCallIssue] - the stubs lack the arguments


def _stat(info: FileInfo) -> RemoteStat | None:
    from pyarrow.fs import FileType  # noqa: PLC0415 - slow to import, and only jobs with URLs need it

    if info.type == FileType.NotFound:
        return None
    mode = S_IFREG if info.type == FileType.File else S_IFDIR
    return RemoteStat(mode, info.size or 0, info.mtime_ns or 0)
