"""Parquet segments: the options and checksums of their columns, and the writer of one segment."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Protocol, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from msgspec import Struct
from numpy.typing import NDArray
from xxhash import xxh3_128, xxh3_128_digest

from mosaico_ingest.destinations import has_nested_lists, topic_schema
from mosaico_ingest.destinations.store import files
from mosaico_ingest.job.values import Compression
from mosaico_ingest.lazy import cache_by_identity
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.remote import AnyPath

_LEVEL, _SMALL_LEVEL = 1, 9
"""Compression levels of zstd for `fast` and `small`."""
_PLAIN_ENCODING, _DICTIONARY = "PLAIN", "RLE_DICTIONARY"
_ENCODINGS = (
    _DICTIONARY,
    "BYTE_STREAM_SPLIT",
    "DELTA_BINARY_PACKED",
    "DELTA_LENGTH_BYTE_ARRAY",
    "DELTA_BYTE_ARRAY",
)
"""Encodings that `small` tries, which DuckDB and Polars read for the types in `_takes`."""
_SAMPLE_ROWS, _SAMPLE_SLICES, _MAX_SAMPLE_BYTES = 1 << 14, 4, 2 << 20
"""Size of the sample in which `small` compares encodings."""
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


def leaves_of(schema: pa.Schema) -> tuple[Leaf, ...]:
    """Return the Parquet columns of a schema, in the order of Parquet's column numbers."""
    return tuple(
        leaf
        for field in schema
        for leaf in _walk(Leaf(field.name, (field.name,), field.type, repeated=False))
    )


def options_of_few_rows(leaves: tuple[Leaf, ...]) -> dict[str, Any]:
    """Return the options of `pq.ParquetWriter` for files that are too small for compression."""
    return _options(leaves, {leaf.parquet_path for leaf in leaves})


def are_few(rows: pa.Table, leaves: tuple[Leaf, ...]) -> bool:
    """Return whether compressing the rows takes longer than writing them, and saves no disk block."""
    return rows.nbytes < max(_MIN_BYTES, _MIN_COLUMN_BYTES * len(leaves))


def fast_options(leaves: tuple[Leaf, ...], rows: pa.Table) -> dict[str, Any]:
    """Return the options of `pq.ParquetWriter`, chosen by type, and for blobs by the compression of a sample.

    Byte stream split makes floats smaller and faster to write than plain or dictionary pages. Compressed images do not
    shrink further.
    """
    dense = (leaf for leaf in leaves if _is_blob(leaf) and not _is_compressible(leaf, rows))
    return _options(leaves, {leaf.parquet_path for leaf in dense})


def small_options(leaves: tuple[Leaf, ...], rows: pa.Table) -> dict[str, Any]:
    """Return the options of `pq.ParquetWriter` that make a sample of the rows smallest, column by column."""
    dense = {leaf.parquet_path for leaf in leaves if _is_blob(leaf) and not _is_compressible(leaf, rows)}
    sample = _sampled_rows(
        rows.select(sorted({leaf.steps[0] for leaf in leaves}, key=rows.column_names.index))
    )
    smallest: dict[str, tuple[int, str]] = {}
    for encoding in (_PLAIN_ENCODING, *_ENCODINGS):
        choice = {leaf.parquet_path: encoding for leaf in leaves if _takes(leaf, encoding)}
        if choice:
            options = _chosen_options(leaves, choice, dense)
            sizes = _column_bytes(sample, options)
            for path in choice:
                if path not in smallest or sizes[path] < smallest[path][0]:
                    smallest[path] = (sizes[path], encoding)
    return _chosen_options(leaves, {path: encoding for path, (_, encoding) in smallest.items()}, dense)


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


def _takes(leaf: Leaf, encoding: str) -> bool:
    """Return whether `small` tries an encoding for a column."""
    kind = leaf.type
    if encoding == _PLAIN_ENCODING:
        return True
    if encoding == _DICTIONARY:
        return not _is_blob(leaf) and not pa.types.is_boolean(kind)
    if encoding == "BYTE_STREAM_SPLIT":
        return _is_float(kind)
    if encoding == "DELTA_BINARY_PACKED":
        return pa.types.is_integer(kind) and kind.bit_width >= 32  # noqa: PLR2004 - smaller integers are 32 bits in Parquet
    return _is_text(kind)


def _chosen_options(
    leaves: tuple[Leaf, ...], choice: Mapping[str, str], uncompressed: Collection[str]
) -> dict[str, Any]:
    """Return the writer's options with an encoding for each column, by default plain."""
    zstd = [leaf.parquet_path for leaf in leaves if leaf.parquet_path not in uncompressed]
    encodings = {
        path: encoding for path, encoding in choice.items() if encoding not in {_PLAIN_ENCODING, _DICTIONARY}
    }
    return {
        "compression": dict.fromkeys(zstd, "zstd") | dict.fromkeys(uncompressed, "none"),
        "compression_level": dict.fromkeys(zstd, _SMALL_LEVEL),
        "use_dictionary": [path for path, encoding in choice.items() if encoding == _DICTIONARY],
        "column_encoding": encodings,
        "write_statistics": [leaf.parquet_path for leaf in leaves if not _is_blob(leaf)],
    }


def _sampled_rows(rows: pa.Table) -> pa.Table:
    """Return slices of the rows at equal distances, whose blobs are limited by the number of rows."""
    count = max(1, min(_SAMPLE_ROWS, len(rows) * _MAX_SAMPLE_BYTES // max(rows.nbytes, 1)))
    if count >= len(rows):
        return rows
    length = max(1, count // _SAMPLE_SLICES)
    starts = range(0, len(rows) - length + 1, max(1, (len(rows) - length) // (_SAMPLE_SLICES - 1)))
    return pa.concat_tables([rows.slice(start, length) for start in starts]).combine_chunks()


def _column_bytes(rows: pa.Table, options: Mapping[str, Any]) -> dict[str, int]:
    """Return the size of each column of rows that are written with these options."""
    footers: list[pq.FileMetaData] = []
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(
        sink, rows.schema, use_compliant_nested_type=False, metadata_collector=footers, **options
    ) as writer:
        writer.write_table(rows, row_group_size=max(1, len(rows)))
    group = footers[0].row_group(0)
    columns = [group.column(number) for number in range(group.num_columns)]
    return {column.path_in_schema: column.total_compressed_size for column in columns}


def column_makers(schema: pa.Schema) -> tuple[ColumnMaker, ...]:
    """Return a factory of the hash state of each column."""
    return tuple(_maker(field.type) for field in schema)


class ContentHash:
    """XXH3 (128 bits) over the columns of successive tables.

    The checksum of a column covers which values are null, the lengths of lists and texts, and the bytes of values that
    are not null. It does not depend on the memory behind nulls, on the division into chunks, or on the file encoding.
    """

    def __init__(self, makers: tuple[ColumnMaker, ...]) -> None:
        self._columns = [make() for make in makers]

    def add(self, rows: pa.Table | pa.RecordBatch) -> None:
        """Add the next rows."""
        for column, values in zip(self._columns, rows.columns, strict=True):
            for chunk in values.chunks if isinstance(values, pa.ChunkedArray) else (values,):
                if len(chunk):
                    column.add(chunk)

    def hexdigest(self) -> str:
        """Return the checksum of all rows so far, 32 hexadecimal digits."""
        return xxh3_128(b"".join(column.digest() for column in self._columns)).hexdigest()


def combined(checksums: Iterable[str | None]) -> str | None:
    """Return one checksum for the rows of several segments, or None if there are none or one is missing."""
    values = list(checksums)
    present = [value for value in values if value is not None]
    if not present or len(present) < len(values):
        return None
    return present[0] if len(present) == 1 else xxh3_128("".join(present).encode()).hexdigest()


class _Column(Protocol):
    def add(self, array: pa.Array[Any]) -> None:
        """Add one chunk that is not empty."""
        ...

    def add_nulls(self, count: int) -> None:
        """Add a chunk in which every value is null."""
        ...

    def digest(self) -> bytes: ...


ColumnMaker: TypeAlias = Callable[[], _Column]
"""Creates the hash state of one column."""


class _Bytes:
    """A hash of bytes in pieces, created with the first piece, since many columns have no bytes."""

    def __init__(self) -> None:
        self._hash: Any = None

    def update(self, piece: bytes | memoryview) -> None:
        if self._hash is None:
            self._hash = xxh3_128()
        self._hash.update(piece)

    def digest(self, end: bytes = b"") -> bytes:
        """Return the checksum of all pieces so far and `end`."""
        if self._hash is None:
            return xxh3_128_digest(end)
        ended = self._hash.copy()
        ended.update(end)
        return ended.digest()


class _Nulls:
    """The positions of nulls, as the lengths of alternating runs of values and nulls."""

    def __init__(self) -> None:
        self._hash = _Bytes()
        self._valid = True
        self._run = 0

    def add(self, array: pa.Array[Any]) -> int:
        """Add a chunk and return its number of nulls."""
        nulls = array.null_count
        if not nulls or nulls == len(array):
            self.extend_by(len(array), valid=not nulls)
            return nulls
        valid = array.is_valid().to_numpy(zero_copy_only=False)
        edges = np.flatnonzero(valid[1:] != valid[:-1]) + 1
        self._extend(np.diff(edges, prepend=0, append=len(array)), valid=bool(valid[0]))
        return nulls

    def present(self, array: pa.Array[Any]) -> Any:  # noqa: ANN401 - any Arrow array; the stubs have no common base
        """Add a chunk and return its values without nulls, or None if all are null."""
        nulls = self.add(array)
        if nulls == len(array):
            return None
        return array.drop_null() if nulls else array

    def digest(self) -> bytes:
        return self._hash.digest(self._run.to_bytes(8, "little"))

    def extend_by(self, run: int, *, valid: bool) -> None:
        """Append one run; most chunks are one run."""
        if valid is self._valid:
            self._run += run
        else:
            self._hash.update(self._run.to_bytes(8, "little"))
            self._valid, self._run = valid, run

    def _extend(self, runs: NDArray[np.int64], *, valid: bool) -> None:
        """Append alternating runs; the last one stays open because the next chunk may continue it."""
        if valid is self._valid:
            runs[0] += self._run
        else:
            self._hash.update(self._run.to_bytes(8, "little"))
        self._hash.update(runs[:-1].astype("<i8").tobytes())
        self._valid = valid if len(runs) % 2 else not valid
        self._run = int(runs[-1])


class _Numbers:
    """Values of fixed width."""

    def __init__(self) -> None:
        self._nulls = _Nulls()
        self._hash = _Bytes()

    def add(self, array: pa.Array[Any]) -> None:
        values = self._nulls.present(array)
        if values is not None:
            width = values.type.bit_width // 8
            self._hash.update(_piece(values.buffers()[1], values.offset * width, len(values) * width))

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._hash.digest()


class _Texts:
    """Values of variable length."""

    def __init__(self, offset: type[np.int32 | np.int64]) -> None:
        self._nulls = _Nulls()
        self._lengths = _Bytes()
        self._hash = _Bytes()
        self._offset = np.dtype(offset)

    def add(self, array: pa.Array[Any]) -> None:
        values = self._nulls.present(array)
        if values is None:
            return
        _, offsets, data = values.buffers()
        width = self._offset.itemsize
        ends = np.frombuffer(_piece(offsets, values.offset * width, (len(values) + 1) * width), self._offset)
        self._lengths.update(np.diff(ends).astype("<i8").tobytes())
        self._hash.update(_piece(data, int(ends[0]), int(ends[-1] - ends[0])))

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._lengths.digest() + self._hash.digest()


class _Lists:
    """Lists of variable or fixed length."""

    def __init__(self, items: ColumnMaker) -> None:
        self._nulls = _Nulls()
        self._lengths = _Bytes()
        self._items = items()

    def add(self, array: pa.Array[Any]) -> None:
        lists = self._nulls.present(array)
        if lists is None:
            return
        if isinstance(lists, pa.ListArray | pa.LargeListArray):
            self._lengths.update(np.diff(lists.offsets.to_numpy()).astype("<i8").tobytes())
        items = lists.flatten()
        if len(items):
            self._items.add(items)

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)

    def digest(self) -> bytes:
        return self._nulls.digest() + self._lengths.digest() + self._items.digest()


class _Structs:
    """Structs; the fields of a null struct are null."""

    def __init__(self, fields: tuple[ColumnMaker, ...]) -> None:
        self._nulls = _Nulls()
        self._fields = [make() for make in fields]

    def add(self, array: pa.Array[Any]) -> None:
        if self._nulls.add(array) == len(array):
            for field in self._fields:
                field.add_nulls(len(array))
            return
        structs: Any = array
        for field, values in zip(self._fields, structs.flatten(), strict=True):
            field.add(values)

    def add_nulls(self, count: int) -> None:
        self._nulls.extend_by(count, valid=False)
        for field in self._fields:
            field.add_nulls(count)

    def digest(self) -> bytes:
        return self._nulls.digest() + b"".join(field.digest() for field in self._fields)


class _Converted:
    """Values that are hashed after a cast to another type."""

    def __init__(self, kind: pa.DataType, make: ColumnMaker) -> None:
        self._kind = kind
        self._values = make()

    def add(self, array: pa.Array[Any]) -> None:
        self._values.add(array.cast(self._kind))

    def add_nulls(self, count: int) -> None:
        self._values.add_nulls(count)

    def digest(self) -> bytes:
        return self._values.digest()


def _maker(kind: Any) -> ColumnMaker:  # noqa: ANN401 - any Arrow type; the stubs have no common base with children
    """Return the factory of the hash state for a type."""
    if isinstance(kind, pa.StructType):
        return partial(_Structs, tuple(_maker(field.type) for field in kind))
    if isinstance(kind, pa.ListType | pa.LargeListType | pa.FixedSizeListType):
        return partial(_Lists, _maker(kind.value_type))
    if isinstance(kind, pa.MapType):  # as a list of its entries
        return _converted(pa.list_(pa.struct([kind.key_field, kind.item_field])))
    if isinstance(kind, pa.DictionaryType):
        return _converted(kind.value_type)
    return _PLAIN.get(kind, _Numbers)


def _converted(kind: pa.DataType) -> ColumnMaker:
    return partial(_Converted, kind, _maker(kind))


_PLAIN: dict[pa.DataType, ColumnMaker] = {
    pa.string(): partial(_Texts, np.int32),
    pa.large_string(): partial(_Texts, np.int64),
    pa.binary(): partial(_Texts, np.int32),
    pa.large_binary(): partial(_Texts, np.int64),
    pa.string_view(): partial(_Converted, pa.large_binary(), partial(_Texts, np.int64)),
    pa.binary_view(): partial(_Converted, pa.large_binary(), partial(_Texts, np.int64)),
    pa.bool_(): partial(_Converted, pa.uint8(), _Numbers),
}


def _piece(buffer: pa.Buffer | None, start: int, size: int) -> memoryview:
    return memoryview(buffer)[start : start + size] if buffer is not None else memoryview(b"")


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
        self.has_nested_lists = has_nested_lists(schema)
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
