"""Checksums of rows depend on their values only, not on batch boundaries or the storage format."""

from __future__ import annotations

import io
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.store.segment import ContentHash, column_makers, combined

WORD = st.text(max_size=4)
ROW = st.fixed_dictionaries(
    {
        "number": st.none() | st.integers(-5, 5),
        "flag": st.none() | st.booleans(),
        "word": st.none() | WORD,
        "blob": st.none() | st.binary(max_size=4),
        "fixed": st.lists(st.floats(width=32), min_size=3, max_size=3),
        "list": st.none() | st.lists(st.none() | st.floats(), max_size=3),
        "struct": st.none()
        | st.fixed_dictionaries({"a": st.none() | st.integers(0, 3), "b": st.lists(WORD, max_size=2)}),
        "structs": st.none()
        | st.lists(st.none() | st.fixed_dictionaries({"x": st.none() | WORD}), max_size=2),
        "map": st.none()
        | st.dictionaries(WORD, st.integers(0, 3), max_size=2).map(lambda found: list(found.items())),
    }
)
SCHEMA = pa.schema(
    {
        "number": pa.int64(),
        "flag": pa.bool_(),
        "word": pa.string(),
        "blob": pa.large_binary(),
        "fixed": pa.list_(pa.float32(), 3),
        "list": pa.list_(pa.float64()),
        "struct": pa.struct([("a", pa.int8()), ("b", pa.list_(pa.string()))]),
        "structs": pa.large_list(pa.struct([("x", pa.string())])),
        "map": pa.map_(pa.string(), pa.int32()),
    }
)


def checksum(*tables: pa.Table | pa.RecordBatch) -> str:
    content = ContentHash(column_makers(tables[0].schema))
    for table in tables:
        content.add(table)
    return content.hexdigest()


def through_parquet(table: pa.Table, rows: int) -> list[pa.RecordBatch]:
    file = io.BytesIO()
    pq.write_table(table, file, row_group_size=rows, use_compliant_nested_type=False)
    return list(pq.ParquetFile(file).iter_batches(batch_size=rows + 1))


@settings(max_examples=30)
@given(st.lists(ROW, min_size=2, max_size=20), st.data())
def test_checksum_of_slices_or_parquet_batches_equals_that_of_table(
    rows: list[dict[str, Any]], data: st.DataObject
) -> None:
    table = pa.Table.from_pylist(rows, SCHEMA)
    cut = data.draw(st.integers(1, len(rows) - 1))
    whole = checksum(table)
    assert checksum(table.slice(0, cut), table.slice(cut)) == whole
    assert checksum(*through_parquet(table, cut)) == whole


@settings(max_examples=30)
@given(st.lists(ROW, min_size=1, max_size=8), st.lists(ROW, min_size=1, max_size=8))
def test_checksum_is_equal_only_for_equal_values(
    one: list[dict[str, Any]], other: list[dict[str, Any]]
) -> None:
    tables = [pa.Table.from_pylist(rows, SCHEMA) for rows in (one, other)]
    files = [
        through_parquet(table, 100) for table in tables
    ]  # values that Parquet does not distinguish are equal
    same = [pa.Table.from_batches(file, SCHEMA) for file in files]
    assert (checksum(*tables[:1]) == checksum(*tables[1:])) == (
        repr(same[0].to_pylist()) == repr(same[1].to_pylist())
    )


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (pa.dictionary(pa.int32(), pa.string()), ["a", None, "b", "a"]),
        (pa.string_view(), ["a", None, "", "a long text that is not stored in its view"]),
        (pa.timestamp("ns"), [1, None, 2, 3]),
        (pa.binary(4), [b"abcd", None, b"aaaa", b"bbbb"]),
        (pa.null(), [None] * 4),
    ],
)
def test_checksum_of_rare_column_type_depends_on_values_only(kind: pa.DataType, values: list[object]) -> None:
    table = pa.table({"column": pa.array(values, kind)})
    assert checksum(table.slice(0, 1), table.slice(1)) == checksum(table)
    assert checksum(table.slice(0, 3)) != checksum(table)


def test_checksum_ignores_bytes_of_null_values() -> None:
    valid = pa.py_buffer(b"\x05")
    behind = [pa.py_buffer(bytes([1, middle, 3])) for middle in (2, 9)]
    one, other = (pa.Array.from_buffers(pa.uint8(), 3, [valid, values]) for values in behind)
    assert checksum(pa.table({"c": one})) == checksum(pa.table({"c": other}))
    assert checksum(pa.table({"c": one})) != checksum(pa.table({"c": pa.array([1, 3, None], pa.uint8())}))


def test_checksum_depends_on_row_order() -> None:
    table = pa.table({"c": [1, 2, 3]})
    assert checksum(table) != checksum(table.take([0, 2, 1]))


def test_combined_with_missing_checksum_is_none() -> None:
    assert combined([]) is None
    assert combined(["a"]) == "a"
    assert combined(["a", None]) is None
    assert combined(["a", "b"]) != combined(["b", "a"])
