"""This file writes one Parquet segment: row groups of one topic, each later than the one before."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.store import files
from mosaico_ingest.store.columns import Columns, Leaf
from mosaico_ingest.store.content import ContentHash

__all__ = ["Bounds", "Segment", "SegmentWriter", "sorted_rows", "time_span"]

Bounds = tuple[str, Any, Any]
"""A column's path, its smallest and its largest value."""

_LONGEST_TEXT = 256
_LARGEST_INTEGER = 1 << 63
_SEND_BYTES = 4 << 20
"""As much as this is not left to be brought to the disk at the end."""


@frozen
class Segment:
    """A finished segment."""

    path: AnyPath
    rows: int
    stored_bytes: int
    start_ns: int
    end_ns: int
    checksum: str
    """Of the values of its rows; see `ContentHash`."""
    bounds: tuple[Bounds, ...]


class SegmentWriter:
    """Writes row groups to `path`; the columns' codecs are chosen from the first rows."""

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
            use_compliant_nested_type=False,  # a list item's name is part of the type readers look for
            sorting_columns=[pq.SortingColumn(0)],
            write_batch_size=4096,
            write_page_checksum=True,
            metadata_collector=self._footer,
            **columns.writer_options(first_rows),
        )

    @property
    def written_bytes(self) -> int:
        """How much is in the file by now."""
        return self._file.tell()

    def append(self, rows: pa.Table) -> None:
        """Write one row group; the rows are sorted, and none is earlier than what is there."""
        self._writer.write_table(rows, row_group_size=max(1, rows.num_rows))
        written = self.written_bytes
        if written - self._sent >= _SEND_BYTES:
            files.send_ahead(self._file, self._sent, written)
            self._sent = written
        self._content.add(rows)
        self.end_ns = rows.column(0)[-1].as_py()

    def close(self) -> Segment:
        """Finish the file; it may not be on the disk yet."""
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
        """Close the file without caring for its content."""
        # a RuntimeError says that there is no footer to collect
        with suppress(OSError, pa.ArrowException, RuntimeError):
            self._writer.close()
        with suppress(OSError, pa.ArrowException):
            self._file.close()


def sorted_rows(batches: Iterable[pa.RecordBatch], schema: pa.Schema) -> pa.Table:
    """Return the rows by time stamp; rows that are in order already are not copied, equal ones keep theirs."""
    table = pa.Table.from_batches(batches, schema)
    times = table.column(0).to_numpy()
    if (times[1:] >= times[:-1]).all():
        return table
    return table.take(np.argsort(times, kind="stable"))


def time_span(footer: pq.FileMetaData, group: int) -> tuple[int, int]:
    """Return the first and the last time stamp of a row group that this file wrote."""
    times = footer.row_group(group).column(0).statistics
    if times is None or not times.has_min_max:
        raise pa.ArrowInvalid("a row group has no statistics of timestamp_ns")
    low: Any = times.min
    high: Any = times.max
    return low, high


def _bounds(columns: tuple[Leaf, ...], footer: pq.FileMetaData) -> Iterable[Bounds]:
    """Yield what the footer says of each column; columns without an order, or with longer values, are left out."""
    groups = [footer.row_group(i) for i in range(footer.num_row_groups)]
    for number, leaf in enumerate(columns):
        statistics = [group.column(number).statistics for group in groups]
        known = [each for each in statistics if each is not None and each.has_min_max]
        if len(known) == len(groups):
            lows: list[Any] = [each.min for each in known]
            highs: list[Any] = [each.max for each in known]
            low, high = min(lows), max(highs)
            if _fits(low) and _fits(high):
                yield leaf.path, low, high


def _fits(value: object) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST_TEXT
    if isinstance(value, int):
        return -_LARGEST_INTEGER <= value < _LARGEST_INTEGER
    return isinstance(value, float)
