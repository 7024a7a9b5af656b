"""A container of Azure Blob Storage as a file system of pyarrow, over obstore.

The Azure client of pyarrow has neither timeouts nor a number of attempts. Errors never contain the query of a URL, because it may
be a shared access signature.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from io import RawIOBase
from typing import TYPE_CHECKING, Any, NoReturn

import obstore
import pyarrow as pa
from obstore import exceptions
from obstore.store import AzureStore
from pyarrow.fs import FileInfo, FileSelector, FileSystemHandler, FileType
from typing_extensions import Buffer

from mosaico_ingest.errors import IngestError, Unreachable
from mosaico_ingest.web_files import Properties, RangedFile

if TYPE_CHECKING:
    from obstore import ObjectMeta, WritableFile
    from obstore.store import AzureConfig

    from mosaico_ingest.remote import Network

_ACCOUNT = ("AZURE_STORAGE_ACCOUNT_NAME", "AZURE_STORAGE_ACCOUNT")
_KEY = ("AZURE_STORAGE_KEY", "AZURE_STORAGE_ACCOUNT_KEY")
_TOKEN = ("AZURE_STORAGE_SAS_TOKEN",)
_FIRST_DELAY, _MAX_DELAY = timedelta(seconds=0.2), timedelta(seconds=10)
_NO_LIMIT = timedelta(days=1)
_STATUS = re.compile(r"status code: (\d\d\d)")


_NO_FOLDERS = "a container has no folders, only blobs whose names contain slashes"


def _refusal(operation: str, reason: str) -> Any:  # noqa: ANN401 - the overridden methods have different signatures
    """Return a method for an operation that the package does not use."""

    def refuse(_: AzureFiles, path: str = "", *_arguments: object) -> NoReturn:
        raise IngestError(
            f"the operation {operation} is not supported: {reason}",
            where=f"az://{path}",
            hint="use the tools of Azure Storage",
        )

    return refuse


class AzureFiles(FileSystemHandler):
    """The blobs of one container; paths start with the name of the container."""

    def __init__(self, container: str, options: Mapping[str, str], network: Network) -> None:
        """Create a client; `options` are those of a URL.

        Raises:
            IngestError: The options and the environment name no storage account.
        """
        account = options.get("account_name") or _environment(*_ACCOUNT)
        if account is None:
            raise IngestError(
                "the URL names no storage account",
                where=f"az://{container}",
                hint="append ?account_name=NAME, or set AZURE_STORAGE_ACCOUNT_NAME",
            )
        config: AzureConfig = {"account_name": account}
        if host := options.get("endpoint_override"):
            address = f"{account}{host}" if host.startswith(".") else f"{host}/{account}"
            config["endpoint"] = f"{options.get('scheme', 'https')}://{address}"
        if key := _environment(*_KEY):
            config["account_key"] = key
        elif token := _environment(*_TOKEN):
            config["sas_key"] = token.removeprefix("?")
        self._store = AzureStore(
            container,
            config=config,
            client_options={
                "allow_http": options.get("scheme") == "http",
                "connect_timeout": timedelta(seconds=network.connect_s),
                "read_timeout": timedelta(seconds=network.request_s),
                "timeout": _NO_LIMIT,  # of a complete response, which may be large
            },
            retry_config={
                "max_retries": network.attempts - 1,
                "retry_timeout": _NO_LIMIT,
                "backoff": {"init_backoff": _FIRST_DELAY, "max_backoff": _MAX_DELAY, "base": 2},
            },
        )

    def properties(self, path: str, *, cached: bool = True) -> Properties | None:  # noqa: ARG002 - the signature of `WebFiles`
        """Return the properties of a blob, None if it does not exist."""
        try:
            with _translated_errors(path):
                return _properties(obstore.head(self._store, _blob(path)))
        except FileNotFoundError:
            return None

    def read_range(self, path: str, start: int, end: int) -> bytes:
        """Return a range of a blob."""
        with _translated_errors(path):
            return bytes(obstore.get_range(self._store, _blob(path), start=start, end=end))

    def get_type_name(self) -> str:
        """Return the name of the type of file system."""
        return "az"

    def normalize_path(self, path: str) -> str:
        """Return the path as it is."""
        return path

    def get_file_info(self, paths: str | list[str]) -> list[FileInfo]:
        """Return the properties of blobs and folders; a folder exists if it contains blobs."""
        return [self._file_info(path) for path in ([paths] if isinstance(paths, str) else paths)]

    def _file_info(self, path: str) -> FileInfo:
        properties = self.properties(path) if _blob(path) else None
        if properties is not None:
            return _file(path, properties)
        with _translated_errors(path):
            is_folder = any(obstore.list(self._store, _blob(path) or None, chunk_size=1))
        return FileInfo(path, FileType.Directory if is_folder else FileType.NotFound)

    def get_file_info_selector(self, selector: FileSelector) -> list[FileInfo]:
        """Return the blobs and folders in a folder; a missing folder is empty."""
        container, prefix = selector.base_dir.partition("/")[0], _blob(selector.base_dir)
        with _translated_errors(selector.base_dir):
            if selector.recursive:
                blobs = [blob for chunk in obstore.list(self._store, prefix or None) for blob in chunk]
                folders = {folder for blob in blobs for folder in _folders(blob["path"], prefix)}
            else:
                listing = obstore.list_with_delimiter(self._store, prefix or None)
                blobs, folders = list(listing["objects"]), set(listing["common_prefixes"])
        return [
            *(FileInfo(f"{container}/{folder.rstrip('/')}", FileType.Directory) for folder in folders),
            *(_file(f"{container}/{blob['path']}", _properties(blob)) for blob in blobs),
        ]

    def open_input_file(self, path: str) -> pa.PythonFile:
        """Open a blob for random access."""
        properties = self.properties(path)
        if properties is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), path)
        return pa.PythonFile(_Input(self, path, properties.size), mode="r")

    def open_input_stream(self, path: str) -> pa.PythonFile:
        """Open a blob for sequential reading."""
        return self.open_input_file(path)

    def open_output_stream(self, path: str, metadata: object) -> pa.PythonFile:  # noqa: ARG002 - the signature of the base class
        """Open a blob for writing; it becomes visible when the file is closed."""
        return pa.PythonFile(_Output(obstore.open_writer(self._store, _blob(path)), path), mode="w")

    def delete_file(self, path: str) -> None:
        """Remove a blob."""
        with _translated_errors(path):
            obstore.delete(self._store, _blob(path))

    create_dir = _refusal("create_dir", _NO_FOLDERS)
    delete_dir = _refusal("delete_dir", _NO_FOLDERS)
    delete_dir_contents = _refusal("delete_dir_contents", _NO_FOLDERS)
    delete_root_dir_contents = _refusal("delete_root_dir_contents", _NO_FOLDERS)
    move = _refusal("move", "a blob cannot be renamed")
    copy_file = _refusal("copy_file", "the store copies content by reading and writing it")
    open_append_stream = _refusal("open_append_stream", "a blob is written once")


class _Input(RangedFile):
    """A blob that reads each range with one request."""

    def __init__(self, files: AzureFiles, path: str, size: int) -> None:
        super().__init__(size)
        self._files = files
        self._path = path

    def fetch(self, start: int, end: int) -> bytes:
        return self._files.read_range(self._path, start, end)


class _Output(RawIOBase):
    """A blob that is uploaded in blocks."""

    def __init__(self, writer: WritableFile, path: str) -> None:
        super().__init__()
        self._writer = writer
        self._path = path

    def writable(self) -> bool:
        return True

    def write(self, data: Buffer) -> int:
        with _translated_errors(self._path):
            return self._writer.write(bytes(data))

    def close(self) -> None:
        if not self.closed:
            super().close()
            with _translated_errors(self._path):
                self._writer.close()


def _environment(*names: str) -> str | None:
    """Return the value of the first environment variable that is set."""
    return next((value for name in names if (value := os.environ.get(name))), None)


def _blob(path: str) -> str:
    """Return the name of a blob in its container."""
    return path.partition("/")[2]


def _folders(blob: str, prefix: str) -> list[str]:
    """Return the folders between a prefix and a blob."""
    parts = blob.split("/")
    folders = ("/".join(parts[:depth]) for depth in range(1, len(parts)))
    return [folder for folder in folders if len(folder) > len(prefix)]


def _properties(blob: ObjectMeta) -> Properties:
    modified_ns = int(blob["last_modified"].timestamp()) * 10**9
    return Properties(blob["size"], modified_ns, blob["e_tag"] or "", has_ranges=True)


def _file(path: str, properties: Properties) -> FileInfo:
    return FileInfo(path, FileType.File, size=properties.size, mtime_ns=properties.modified_ns)


@contextmanager
def _translated_errors(path: str) -> Generator[None, None, None]:
    """Raise the errors of the package for errors of obstore, whose text contains the URL."""
    where = f"az://{path}"
    try:
        yield
    except (FileNotFoundError, exceptions.BaseError) as err:
        text = str(err)
        if "ContainerNotFound" in text:
            raise IngestError(
                "the container does not exist", where=where, hint="check the URL; containers are not created"
            ) from None
        if isinstance(err, FileNotFoundError):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), where) from None
        if isinstance(err, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError):
            hint = "check the credentials: AZURE_STORAGE_KEY, AZURE_STORAGE_SAS_TOKEN, or the machine's role"
            raise IngestError(f"access is refused: {_reason(text)}", where=where, hint=hint) from None
        raise Unreachable(
            f"does not respond: {_reason(text)}", where=where, hint="check the address and the network"
        ) from None


def _reason(text: str) -> str:
    """Return the status or the last cause in the text of an error."""
    status = _STATUS.search(text)
    if status is not None:
        return f"HTTP status {status[1]}"
    return text.partition("\n\nDebug source")[0].rpartition(" - ")[2].partition("(http")[0].strip()
