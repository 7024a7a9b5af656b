"""Parquet segments: column encodings and the writer of one segment."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from msgspec import Struct

from mosaico_ingest.caching import cache_by_identity
from mosaico_ingest.destinations.base import topic_schema
from mosaico_ingest.destinations.store import files
from mosaico_ingest.destinations.store.checksum import ContentHash, column_makers
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.remote import AnyPath

_LEVEL = 1
"""Compression level of zstd."""
_SAMPLE_BYTES = 1 << 18
_SAMPLES = 16
_PIECE_BYTES = _SAMPLE_BYTES // _SAMPLES
_MIN_BYTES, _MIN_COLUMN_BYTES = 1 << 12, 1 << 8
"""Sizes of rows, in total and per column, below which compression takes longer than writing the uncompressed bytes."""
_MAX_COMPRESSED_SHARE = 0.9
"""Compressed size of a sample, relative to its size, above which a column is not compressed."""


class Leaf(Struct, frozen=True):
    """One Parquet column: a value without children."""

    parquet_path: str
    """The path in Parquet, as `transforms.list.item.x`."""
    steps: tuple[str, ...]
    """The names of the fields on the path, as `("transforms", "x")`."""
    type: pa.DataType
    repeated: bool
    """Whether the column is inside a list."""

    @property
    def path(self) -> str:
        """The path for users, as `transforms.x`."""
        return ".".join(self.steps)


class Columns:
    """The Parquet columns of one schema, with the writer options of each.

    Raises:
        pa.ArrowInvalid: Parquet cannot store the columns; raised before a file is created.
    """

    def __init__(self, schema: pa.Schema) -> None:
        if len(set(schema.names)) != len(schema.names):
            raise pa.ArrowInvalid(f"a column name is used twice: {schema.names}")
        pq.ParquetWriter(pa.BufferOutputStream(), schema, use_compliant_nested_type=False).close()
        self.schema = schema
        self.leaves = tuple(
            leaf
            for field in schema
            for leaf in _walk(Leaf(field.name, (field.name,), field.type, repeated=False))
        )
        """The columns in the order of Parquet's column numbers."""
        self.makers = column_makers(schema)
        self._options_of_few_rows = _options(self.leaves, {leaf.parquet_path for leaf in self.leaves})

    def writer_options(self, rows: pa.Table) -> dict[str, Any]:
        """Return the options of `pq.ParquetWriter`, chosen by type, and for blobs by the compression of a sample.

        Byte stream split makes floats smaller and faster to write than plain or dictionary pages. Compressed images do
        not shrink further, and compressing a few rows saves no disk block.
        """
        if rows.nbytes < max(_MIN_BYTES, _MIN_COLUMN_BYTES * len(self.leaves)):
            return self._options_of_few_rows
        dense = (leaf for leaf in self.leaves if _is_blob(leaf) and not _is_compressible(leaf, rows))
        return _options(self.leaves, {leaf.parquet_path for leaf in dense})


@cache_by_identity
def columns_of(ontology: OntologyType) -> Columns:
    """Return the columns of a topic of this type."""
    return Columns(topic_schema(ontology))


def _walk(at: Leaf) -> Iterator[Leaf]:
    kind = at.type
    if isinstance(kind, pa.StructType):
        for child in kind:
            path = f"{at.parquet_path}.{child.name}"
            yield from _walk(Leaf(path, (*at.steps, child.name), child.type, at.repeated))
    elif isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
        path = f"{at.parquet_path}.list.{kind.value_field.name}"
        yield from _walk(Leaf(path, at.steps, kind.value_type, repeated=True))
    elif isinstance(kind, pa.MapType):
        for child in (kind.key_field, kind.item_field):
            path = f"{at.parquet_path}.key_value.{child.name}"
            yield from _walk(Leaf(path, (*at.steps, child.name), child.type, repeated=True))
    else:
        yield at


def _options(columns: tuple[Leaf, ...], uncompressed: Collection[str]) -> dict[str, Any]:
    """Return the writer's options; `uncompressed` are the paths of columns that are not compressed."""
    zstd = [leaf.parquet_path for leaf in columns if leaf.parquet_path not in uncompressed]
    encodings = {leaf.parquet_path: "BYTE_STREAM_SPLIT" for leaf in columns if _is_float(leaf.type)}
    encodings[columns[0].parquet_path] = "DELTA_BINARY_PACKED"
    return {
        "compression": dict.fromkeys(zstd, "zstd") | dict.fromkeys(uncompressed, "none"),
        "compression_level": dict.fromkeys(zstd, _LEVEL),
        "use_dictionary": [leaf.parquet_path for leaf in columns if _is_text(leaf.type)],
        "column_encoding": encodings,
        "write_statistics": [leaf.parquet_path for leaf in columns if not _is_blob(leaf)],
    }


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)


def _is_blob(leaf: Leaf) -> bool:
    return _is_binary(leaf.type) or (leaf.repeated and leaf.type in {pa.uint8(), pa.int8()})


def _is_binary(kind: pa.DataType) -> bool:
    return pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_binary_view(kind)


def _is_float(kind: pa.DataType) -> bool:
    return pa.types.is_float32(kind) or pa.types.is_float64(kind)


def _is_compressible(leaf: Leaf, rows: pa.Table) -> bool:
    """Return whether zstd shrinks a sample of the column; true if the sample is too small to tell."""
    sample = b"".join(_samples(leaf, rows))
    if len(sample) < _MIN_BYTES:
        return True
    compressed = pa.Codec("zstd", compression_level=_LEVEL).compress(sample)
    return len(compressed) < _MAX_COMPRESSED_SHARE * len(sample)


def _samples(leaf: Leaf, rows: pa.Table) -> Iterator[bytes]:
    """Yield bytes from the middle of a few values, since headers compress better than the rest."""
    for chunk in rows.column(leaf.steps[0]).chunks[:_SAMPLES]:
        values: pa.Array[Any] = chunk
        for step in leaf.steps[1:]:
            values = pc.struct_field(_values(values), step)
        values = _values(values)
        if _is_binary(values.type):
            for blob in values.slice(len(values) // 2, _SAMPLES).drop_null():
                data = blob.as_buffer()
                yield data.slice(data.size // 2, min(data.size // 2, _PIECE_BYTES)).to_pybytes()
        else:
            yield values.drop_null().slice(len(values) // 2, _PIECE_BYTES).to_numpy().tobytes()


def _values(array: pa.Array[Any]) -> pa.Array[Any]:
    while isinstance(array, pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        array = array.flatten()
    return array


Bounds = tuple[str, Any, Any]
"""Path, smallest and largest value of a column."""

_LONGEST_TEXT = 256
_LARGEST_INTEGER = 1 << 63
_SEND_BYTES = 4 << 20
"""Number of bytes after which writing to the disk is started."""


class Segment(Struct, frozen=True):
    """A finished segment."""

    path: AnyPath
    rows: int
    stored_bytes: int
    start_ns: int
    end_ns: int
    checksum: str
    """Checksum of the row values; see `ContentHash`."""
    bounds: tuple[Bounds, ...]


class SegmentWriter:
    """Writes row groups to `path`; the first rows determine the compression of the columns."""

    def __init__(self, path: AnyPath, columns: Columns, first_rows: pa.Table) -> None:
        self.path = path
        self.end_ns = -(1 << 63)
        self._columns = columns
        self._content = ContentHash(columns.makers)
        self._file = files.create(path)
        self._sent = 0
        self._footer: list[pq.FileMetaData] = []
        self._writer = pq.ParquetWriter(
            self._file,
            columns.schema,
            use_compliant_nested_type=False,  # the name of list items is part of the type
            sorting_columns=[pq.SortingColumn(0)],
            write_batch_size=4096,
            write_page_checksum=True,
            metadata_collector=self._footer,
            **columns.writer_options(first_rows),
        )

    @property
    def written_bytes(self) -> int:
        """Size of the file so far, in bytes."""
        return self._file.tell()

    def append(self, rows: pa.Table) -> None:
        """Write one row group of sorted rows that are not earlier than the previous ones."""
        self._writer.write_table(rows, row_group_size=max(1, rows.num_rows))
        written = self.written_bytes
        if written - self._sent >= _SEND_BYTES:
            files.send_ahead(self._file, self._sent, written)
            self._sent = written
        self._content.add(rows)
        self.end_ns = rows.column(0)[-1].as_py()

    def close(self) -> Segment:
        """Finish the file, which need not be on the disk yet."""
        self._writer.close()
        self._file.close()
        (footer,) = self._footer
        bounds = tuple(_bounds(self._columns.leaves, footer))
        _, start_ns, end_ns = bounds[0]
        return Segment(
            self.path,
            footer.num_rows,
            self.path.stat().st_size,
            start_ns,
            end_ns,
            self._content.hexdigest(),
            bounds,
        )

    def abandon(self) -> None:
        """Close the file, whose content is discarded."""
        # pyarrow raises RuntimeError if there is no footer to collect.
        with suppress(OSError, pa.ArrowException, RuntimeError):
            self._writer.close()
        with suppress(OSError, pa.ArrowException):
            self._file.close()


def sorted_rows(batches: Iterable[pa.RecordBatch], schema: pa.Schema) -> pa.Table:
    """Return the rows sorted by time stamp (stable); rows that are in order are not copied."""
    table = pa.Table.from_batches(batches, schema)
    times = table.column(0).to_numpy()
    if (times[1:] >= times[:-1]).all():
        return table
    return table.take(np.argsort(times, kind="stable"))


def time_span(footer: pq.FileMetaData, group: int) -> tuple[int, int]:
    """Return the first and the last time stamp of a row group."""
    times = footer.row_group(group).column(0).statistics
    if times is None or not times.has_min_max:
        raise pa.ArrowInvalid("a row group has no statistics of timestamp_ns")
    low: Any = times.min
    high: Any = times.max
    return low, high


def _bounds(columns: tuple[Leaf, ...], footer: pq.FileMetaData) -> Iterable[Bounds]:
    """Yield the bounds of each column in the footer, except for columns without an order or with long values."""
    groups = [footer.row_group(i) for i in range(footer.num_row_groups)]
    for number, leaf in enumerate(columns):
        statistics = [group.column(number).statistics for group in groups]
        bounded = [each for each in statistics if each is not None and each.has_min_max]
        if len(bounded) == len(groups):
            lows: list[Any] = [each.min for each in bounded]
            highs: list[Any] = [each.max for each in bounded]
            low, high = min(lows), max(highs)
            if _fits(low) and _fits(high):
                yield leaf.path, low, high


def _fits(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST_TEXT
    if isinstance(value, int):
        return -_LARGEST_INTEGER <= value < _LARGEST_INTEGER
    return isinstance(value, float)
