"""The snapshot of the catalog of a store behind a URL: the documents of its sequences in one Parquet file.

A snapshot is a cache that needs no agreement with writers: a row is valid while the object store lists its document with the
same size and the same time of change. Documents that changed later, or that the snapshot lacks, are read one by one. A
snapshot that is out of date, lost or written by several processes at the same time is therefore slow at worst.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice

import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct

from mosaico_ingest.destinations.store.errors import translate_errors
from mosaico_ingest.errors import IngestError
from mosaico_ingest.remote import RemotePath

SUMMARY, DOCUMENT = "summary", "document"
"""The columns with the content of a row."""
_FOLDER = "snapshots"
_FILE = "catalog-1.parquet"
"""The name contains the version of the columns."""
_SETTLED_NS = 5 * 10**9
"""Time since the last change after which a document may be in a snapshot; object stores list times in full seconds, so a
later change of the same second would not be visible."""
_GROUP_ROWS = 1000
_SCHEMA = pa.schema(
    [
        pa.field("key", pa.string()),
        pa.field("size", pa.int64()),
        pa.field("mtime_ns", pa.int64()),
        pa.field(SUMMARY, pa.binary()),
        pa.field(DOCUMENT, pa.binary()),
    ]
)


class Content(Struct, frozen=True):
    """The content of a row, as JSON."""

    summary: bytes
    document: bytes


def read_rows(root: RemotePath, column: str, documents: Mapping[str, RemotePath]) -> dict[str, bytes]:
    """Return a column of the snapshot for the listed documents that have not changed since; empty without a snapshot."""
    rows: dict[str, bytes] = {}
    for batch in _batches(root, ["key", "size", "mtime_ns", column]):
        selected = _unchanged(batch, documents)
        keys, values = batch.column("key").take(selected), batch.column(column).take(selected)
        rows.update(
            (str(key), value)
            for key, value in zip(keys.to_pylist(), values.to_pylist(), strict=True)
            if value is not None
        )
    return rows


def write_snapshot(
    root: RemotePath,
    list_documents: Callable[[], Mapping[str, RemotePath]],
    read: Callable[[Sequence[RemotePath]], Sequence[Content | None]],
) -> None:
    """Write a snapshot of all documents that have settled, and take rows that are valid from the earlier snapshot.

    `read` returns the contents of documents, and None for each that no longer exists.

    Raises:
        SinkError: The snapshot cannot be written.
    """
    clock = root / _FOLDER / "clock"
    with translate_errors(root):
        clock.write_bytes(b"")  # its time of change is the time of the server
        settled_ns = clock.stat().st_mtime_ns - _SETTLED_NS
    missing = {key: path for key, path in list_documents().items() if path.stat().st_mtime_ns <= settled_ns}
    target = root / _FOLDER / _FILE
    with (
        translate_errors(root),
        pq.ParquetWriter(
            target.filesystem_path, _SCHEMA, filesystem=target.filesystem, compression="zstd"
        ) as writer,
    ):
        for batch in _batches(root, _SCHEMA.names):
            valid = batch.take(_unchanged(batch, missing))
            writer.write_batch(valid)
            for key in valid.column("key").to_pylist():
                missing.pop(str(key))
        paths = iter(missing.values())
        while group := list(islice(paths, _GROUP_ROWS)):
            writer.write_batch(pa.RecordBatch.from_pylist(list(_rows(group, read(group))), schema=_SCHEMA))


def _rows(paths: Sequence[RemotePath], contents: Iterable[Content | None]) -> Iterator[dict[str, object]]:
    for path, content in zip(paths, contents, strict=True):
        if content is not None:
            stat = path.stat()  # of the listing
            yield {
                "key": path.name,
                "size": stat.st_size,
                "mtime_ns": stat.st_mtime_ns,
                SUMMARY: content.summary,
                DOCUMENT: content.document,
            }


def _batches(root: RemotePath, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the snapshot; none if there is no snapshot, or if it is damaged."""
    path = root / _FOLDER / _FILE
    try:
        with (
            translate_errors(root),
            pq.ParquetFile(path.filesystem_path, filesystem=path.filesystem) as parquet,
        ):
            yield from parquet.iter_batches(batch_size=_GROUP_ROWS, columns=list(columns))
    except (IngestError, OSError, pa.ArrowException):
        return


def _unchanged(batch: pa.RecordBatch, documents: Mapping[str, RemotePath]) -> pa.Int64Array:
    """Return the positions of rows whose document is listed with the same size and time of change."""
    states = zip(*(batch.column(name).to_pylist() for name in ("key", "size", "mtime_ns")), strict=True)
    positions: list[int] = []
    for position, (key, size, mtime_ns) in enumerate(states):
        if key in documents:
            stat = documents[key].stat()
            if (stat.st_size, stat.st_mtime_ns) == (size, mtime_ns):
                positions.append(position)
    return pa.array(positions, pa.int64())
