"""Encodings and compression of Parquet columns, by type and by samples of the values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from msgspec import Struct

_LEVEL, _SMALL_LEVEL = 1, 9
"""Compression levels of zstd for `fast` and `small`."""
_PLAIN, _DICTIONARY = "PLAIN", "RLE_DICTIONARY"
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
    for encoding in (_PLAIN, *_ENCODINGS):
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
    if encoding == _PLAIN:
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
    encodings = {path: encoding for path, encoding in choice.items() if encoding not in {_PLAIN, _DICTIONARY}}
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
