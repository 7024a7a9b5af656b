"""Parquet segments: the columns of a topic and the writer of one segment."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from msgspec import Struct

from mosaico_ingest.caching import cache_by_identity
from mosaico_ingest.destinations.base import topic_schema
from mosaico_ingest.destinations.store import files
from mosaico_ingest.destinations.store.checksum import ContentHash, column_makers
from mosaico_ingest.destinations.store.encodings import (
    Leaf,
    are_few,
    fast_options,
    leaves_of,
    options_of_few_rows,
    small_options,
)
from mosaico_ingest.job.values import Compression
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.remote import AnyPath


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
        self.leaves = leaves_of(schema)
        """The columns in the order of Parquet's column numbers."""
        self.makers = column_makers(schema)
        self._options_of_few_rows = options_of_few_rows(self.leaves)

    def writer_options(self, rows: pa.Table, compression: Compression = Compression.FAST) -> dict[str, Any]:
        """Return the options of `pq.ParquetWriter` for a file that starts with these rows."""
        if are_few(rows, self.leaves):
            return self._options_of_few_rows
        if compression is Compression.SMALL:
            return small_options(self.leaves, rows)
        return fast_options(self.leaves, rows)


@cache_by_identity
def columns_of(ontology: OntologyType) -> Columns:
    """Return the columns of a topic of this type."""
    return Columns(topic_schema(ontology))


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

    def __init__(
        self,
        path: AnyPath,
        columns: Columns,
        first_rows: pa.Table,
        compression: Compression = Compression.FAST,
    ) -> None:
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
            **columns.writer_options(first_rows, compression),
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
