"""Files behind `http://` and `https://` as a read-only file system of pyarrow, read by range.

All requests, including requests for sizes, are GET requests with a range, because a presigned URL allows only one method. urllib3
repeats failed requests. Errors never contain the query of a URL, because it may be secret.
"""

from __future__ import annotations

import errno
import os
import time
from email.utils import parsedate_to_datetime
from io import RawIOBase
from typing import TYPE_CHECKING, Any, NoReturn

import pyarrow as pa
import urllib3
from msgspec import Struct
from pyarrow.fs import FileInfo, FileSystemHandler, FileType

from mosaico_ingest.errors import IngestError, Unreachable

if TYPE_CHECKING:
    from mosaico_ingest.remote import Network

_RETRIED = (408, 429, 500, 502, 503, 504)
_PARTIAL, _OK, _UNSATISFIABLE = 206, 200, 416
_MISSING = {404, 410}
_REFUSED = {401, 403}
_FRESH_S = 2.0
"""Time for which the properties of a file are cached, since opening a recording asks for them several times."""
_SKIP_BYTES = 1 << 20
_BACKOFF_S, _MAX_BACKOFF_S = 0.2, 10.0


class Properties(Struct, frozen=True):
    """The properties of a file according to a response."""

    size: int
    modified_ns: int | None
    version: str
    """The ETag, or else the time of the last change; empty if the server sends neither."""
    has_ranges: bool
    """Whether the server sends ranges; otherwise, it sends the complete file."""


class WebFiles(FileSystemHandler):
    """The files of one web server, for a query that is part of every URL."""

    def __init__(self, root: str, query: str, network: Network) -> None:
        self._root = root
        self._query = query
        self._properties: dict[str, tuple[float, Properties | None]] = {}
        retries = urllib3.Retry(
            total=network.attempts - 1,
            status_forcelist=_RETRIED,
            backoff_factor=_BACKOFF_S,
            backoff_max=_MAX_BACKOFF_S,
            allowed_methods=["GET"],
            raise_on_status=False,
            respect_retry_after_header=True,
        )
        self._pool = urllib3.PoolManager(
            maxsize=8,
            retries=retries,
            timeout=urllib3.Timeout(connect=network.connect_s, read=network.request_s),
            headers={"User-Agent": "mosaico-ingest", "Accept-Encoding": "identity"},
        )

    def request(self, path: str, start: int, stop: int) -> tuple[Any, str]:
        """Return the response of urllib3 to a request for a range of a file, and the URL without its query.

        Raises:
            FileNotFoundError: The file does not exist.
            Unreachable: The server does not respond, or still fails after several attempts.
            IngestError: Access is refused, or the response is otherwise unexpected.
        """
        where = f"{self._root.partition('://')[0]}://{path}"
        url = f"{where}?{self._query}" if self._query else where
        try:
            response = self._pool.request(
                "GET", url, headers={"Range": f"bytes={start}-{stop - 1}"}, preload_content=False
            )
        except urllib3.exceptions.HTTPError as error:
            raise self._unreachable(where, type(_cause(error)).__name__) from None
        status = response.status
        if status in {_OK, _PARTIAL, _UNSATISFIABLE}:
            return response, where
        response.close()
        if status in _MISSING:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), where)
        if status in _REFUSED:
            hint = "check the URL and its permissions; a presigned URL may have expired, so request a new one"
            raise IngestError(f"access is refused: HTTP status {status}", where=where, hint=hint)
        if status in _RETRIED:
            raise self._unreachable(where, f"HTTP status {status}")
        raise IngestError(f"the server responds with HTTP status {status}", where=where, hint="check the URL")

    def properties(self, path: str, *, cached: bool = True) -> Properties | None:
        """Return the properties of a file, None if it does not exist."""
        at_s, file_properties = self._properties.get(path, (-_FRESH_S, None))
        if cached and time.monotonic() - at_s < _FRESH_S:
            return file_properties
        try:
            response, where = self.request(path, 0, 1)
        except FileNotFoundError:
            properties = None
        else:
            try:
                properties = _properties(response, where)
            finally:
                _discard(response)
        self._properties[path] = time.monotonic(), properties
        return properties

    def read_range(self, path: str, start: int, end: int) -> bytes:
        """Return a range of a file of a server that sends ranges."""
        response, where = self.request(path, start, end)
        try:
            return b"" if response.status == _UNSATISFIABLE else self.read(response, where, end - start)
        finally:
            _discard(response)

    def read(self, response: Any, where: str, count: int) -> bytes:  # noqa: ANN401 - a response of urllib3
        """Return the next bytes of a response.

        Raises:
            Unreachable: The server does not respond in time.
        """
        try:
            return response.read(count)
        except urllib3.exceptions.HTTPError as error:
            raise self._unreachable(where, type(_cause(error)).__name__) from None

    def _unreachable(self, where: str, reason: str) -> Unreachable:
        return Unreachable(
            f"does not respond: {reason}", where=where, hint="check the address and the network"
        )

    def get_type_name(self) -> str:
        """Return the name of the type of file system."""
        return "http"

    def normalize_path(self, path: str) -> str:
        """Return the path as it is."""
        return path

    def get_file_info(self, paths: str | list[str]) -> list[FileInfo]:
        """Return the properties of files."""
        infos: list[FileInfo] = []
        for path in [paths] if isinstance(paths, str) else paths:
            properties = self.properties(path)
            if properties is None:
                infos.append(FileInfo(path, FileType.NotFound))
            else:
                infos.append(
                    FileInfo(path, FileType.File, size=properties.size, mtime_ns=properties.modified_ns)
                )
        return infos

    def get_file_info_selector(self, selector: Any) -> list[FileInfo]:  # noqa: ANN401, ARG002 - the signature of the base class
        """Raise IngestError: a web server does not list files."""
        raise IngestError(
            "a web server does not list files", where=self._root, hint="write the URL of each recording"
        )

    def open_input_file(self, path: str) -> pa.PythonFile:
        """Open a file for random access."""
        properties = self.properties(path, cached=False)
        if properties is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        return pa.PythonFile(_WebFile(self, path, properties), mode="r")

    def open_input_stream(self, path: str) -> pa.PythonFile:
        """Open a file for sequential reading."""
        return self.open_input_file(path)

    def _refuse(self, *_: object) -> NoReturn:
        raise IngestError(
            "a web server cannot be written", where=self._root, hint="use a folder, s3://, gs:// or az://"
        )

    _refused: Any = _refuse  # the overridden methods have different signatures
    create_dir = delete_dir = delete_dir_contents = delete_root_dir_contents = _refused
    delete_file = move = copy_file = open_output_stream = open_append_stream = _refused


class RangedFile(RawIOBase):
    """A file for random access; subclasses fetch a range."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self._size = size
        self._position = 0

    def fetch(self, start: int, end: int) -> bytes:
        """Return the bytes of a range inside the file; fewer only if the file has become shorter."""
        raise NotImplementedError

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Change the position, and return it."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = base + offset
        return self._position

    def read(self, size: int | None = -1) -> bytes:
        """Return the next bytes; fewer only at the end of the file."""
        end = self._size if size is None or size < 0 else min(self._position + size, self._size)
        if end <= self._position:
            return b""
        data = self.fetch(self._position, end)
        self._position += len(data)
        return data


class _WebFile(RangedFile):
    """A file that reads each range with one request, or consecutive ranges from one response if the server ignores ranges."""

    def __init__(self, files: WebFiles, path: str, properties: Properties) -> None:
        super().__init__(properties.size)
        self._files = files
        self._path = path
        self._has_ranges = properties.has_ranges
        self._complete: tuple[Any, str] | None = None
        """A response with the complete file, and its URL."""
        self._received = 0
        """Number of bytes read from the response."""

    def fetch(self, start: int, end: int) -> bytes:
        if self._has_ranges:
            return self._files.read_range(self._path, start, end)
        return self._read_on(start, end)

    def close(self) -> None:
        self._drop_response()
        super().close()

    def _drop_response(self) -> None:
        if self._complete is not None:
            _discard(self._complete[0])
            self._complete = None

    def _read_on(self, start: int, end: int) -> bytes:
        """Read from the response with the complete file; request it again if its position is after the range."""
        if self._received > start:
            self._drop_response()
        if self._complete is None:
            self._complete, self._received = self._files.request(self._path, 0, end), 0
        while self._received < start:
            data = self._files.read(*self._complete, min(start - self._received, _SKIP_BYTES))
            if not data:  # the file has become shorter
                return b""
            self._received += len(data)
        data = self._files.read(*self._complete, end - start)
        self._received += len(data)
        return data


def _properties(response: Any, where: str) -> Properties:  # noqa: ANN401 - a response of urllib3
    headers = response.headers
    if response.status == _OK:
        total = headers.get("Content-Length", "")
    else:
        total = headers.get("Content-Range", "").rpartition("/")[2]
    if not total.isdecimal():
        raise IngestError(
            "the server does not send the size of the file", where=where, hint="download the file"
        )
    last_modified = headers.get("Last-Modified")
    try:
        modified_ns = (
            None if last_modified is None else int(parsedate_to_datetime(last_modified).timestamp()) * 10**9
        )
    except ValueError:
        modified_ns = None
    return Properties(
        int(total), modified_ns, headers.get("ETag") or last_modified or "", has_ranges=response.status != _OK
    )


def _discard(response: Any) -> None:  # noqa: ANN401 - a response of urllib3
    """End a response; close its connection if the server is still sending the complete file."""
    if response.status == _OK:
        response.close()
    else:
        response.drain_conn()
    response.release_conn()


def _cause(error: BaseException) -> BaseException:
    """Return the reason of an error after several attempts, whose own text contains the URL."""
    reason = getattr(error, "reason", None)
    return reason if isinstance(reason, BaseException) else error
