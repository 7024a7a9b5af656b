"""Rows with null structs: they pass through Parquet unchanged, also if fields inside are required."""

from __future__ import annotations

import io

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.ontology.registry import RequiredFields

STAMP = pa.struct(
    [pa.field("sec", pa.int32(), nullable=False), pa.field("frame", pa.string(), nullable=False)]
)
ROW = pa.struct(
    [
        pa.field("header", pa.struct([pa.field("stamp", STAMP), pa.field("seq", pa.uint64())])),
        pa.field("pair", pa.list_(pa.field("item", STAMP), 2)),
        pa.field("many", pa.list_(pa.field("item", STAMP))),
        pa.field("inner", pa.struct([pa.field("deep", STAMP, nullable=False)])),
        pa.field("flags", pa.struct([pa.field("list", pa.list_(pa.int8()), nullable=False)])),
    ]
)


def fill_required(rows: pa.StructArray) -> pa.StructArray:
    return RequiredFields(rows.type).fill(rows)


stamps = st.none() | st.fixed_dictionaries({"sec": st.integers(0, 9), "frame": st.sampled_from(["", "map"])})
rows = st.fixed_dictionaries(
    {
        "header": st.none() | st.fixed_dictionaries({"stamp": stamps, "seq": st.none() | st.integers(0, 9)}),
        "pair": st.lists(stamps, min_size=2, max_size=2),
        "many": st.none() | st.lists(stamps, max_size=3),
        "inner": st.none() | st.fixed_dictionaries({"deep": stamps.filter(bool)}),
        "flags": st.none() | st.fixed_dictionaries({"list": st.lists(st.integers(0, 9), max_size=2)}),
    }
)


@given(st.lists(rows, max_size=8), st.integers(0, 3), st.integers(0, 3))
def test_required_fields_fill_keeps_values_and_writes_parquet(
    given_rows: list[dict], front: int, back: int
) -> None:
    array = pa.array(given_rows, ROW)
    array = array[front : max(front, len(array) - back)]
    filled = fill_required(array)
    assert filled.to_pylist() == array.to_pylist()
    table = pa.Table.from_arrays(filled.flatten(), schema=pa.schema(list(ROW)))
    table.validate(full=True)
    file = io.BytesIO()
    pq.write_table(table, file)
    assert pq.read_table(file).to_pylist() == array.to_pylist()


def test_required_fields_without_required_returns_same_array() -> None:
    array = pa.array([{"a": None}, None], pa.struct([pa.field("a", pa.int32())]))
    assert fill_required(array) is array


def test_required_fields_without_null_structs_copies_nothing() -> None:
    array = pa.array([{"stamp": {"sec": 1, "frame": ""}}], pa.struct([pa.field("stamp", STAMP)]))
    assert fill_required(array) is array


@pytest.mark.parametrize("kind", [pa.bool_(), pa.float32(), pa.binary(), pa.string(), pa.uint8()])
def test_required_fields_fill_supports_every_type(kind: pa.DataType) -> None:
    struct = pa.struct([pa.field("x", pa.struct([pa.field("y", kind, nullable=False)]))])
    filled = fill_required(pa.array([{"x": None}], struct))
    assert filled.field(0).field(0).null_count == 0
