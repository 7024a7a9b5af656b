from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.server.session import framing_bytes, row_spans

POINT = pa.struct([pa.field("x", pa.float64()), pa.field("name", pa.string())])
BOX = pa.struct([pa.field("x", pa.int32()), pa.field("ok", pa.bool_())])
COLUMNS: dict[str, tuple[pa.DataType, st.SearchStrategy[Any]]] = {
    "flag": (pa.bool_(), st.booleans()),
    "small": (pa.int8(), st.integers(-9, 9)),
    "text": (pa.string(), st.text(max_size=60)),
    "large": (pa.large_binary(), st.binary(max_size=60)),
    "list": (pa.list_(pa.string()), st.lists(st.text(max_size=9), max_size=5)),
    "fixed": (pa.list_(pa.int16(), 3), st.lists(st.integers(0, 9), min_size=3, max_size=3)),
    "nested": (
        pa.list_(pa.list_(pa.float32())),
        st.lists(st.lists(st.floats(width=32), max_size=4), max_size=4),
    ),
    "points": (
        pa.list_(POINT),
        st.lists(st.fixed_dictionaries({"x": st.floats(), "name": st.text(max_size=4)}), max_size=3),
    ),
    "point": (POINT, st.fixed_dictionaries({"x": st.floats(), "name": st.none() | st.text(max_size=30)})),
    "blob": (pa.binary(), st.binary(max_size=300)),
    "stamp": (pa.binary(4), st.binary(min_size=4, max_size=4)),
    "large_list": (pa.large_list(pa.int64()), st.lists(st.integers(0, 9), max_size=9)),
    "box": (
        pa.list_(BOX),
        st.lists(st.fixed_dictionaries({"x": st.integers(0, 9), "ok": st.none()}), max_size=3),
    ),
    "nothing": (pa.null(), st.none()),
}
SCHEMA = pa.schema([pa.field(name, kind) for name, (kind, _) in COLUMNS.items()])
ROWS = st.lists(
    st.fixed_dictionaries({name: st.none() | values for name, (_, values) in COLUMNS.items()}), max_size=40
)


@settings(deadline=None, max_examples=60)
@given(rows=ROWS, most=st.integers(64, 6000), cut=st.tuples(st.integers(0, 5), st.integers(0, 40)))
def test_row_spans_cover_every_row_and_fit_into_message(
    rows: list[dict[str, Any]], most: int, cut: tuple[int, int]
) -> None:
    batch = pa.RecordBatch.from_pylist(rows, SCHEMA).slice(*cut)
    spans = row_spans(batch, max_bytes=most)
    assert [row for first, count, _ in spans for row in range(first, first + count)] == list(
        range(batch.num_rows)
    )
    for first, count, size in spans:
        assert size <= most or count == 1
        encoded = pa.ipc.get_record_batch_size(batch.slice(first, count))
        assert encoded <= size + framing_bytes(SCHEMA)


def test_row_spans_sizes_approximate_encoded_size() -> None:
    rows = [
        {"text": "x" * 50, "list": ["ab"] * 4, "points": [{"x": 1.0, "name": "n"}], "fixed": [1, 2, 3]}
    ] * 4000
    batch = pa.RecordBatch.from_pylist(rows, SCHEMA)
    ((_, _, whole),) = row_spans(batch, max_bytes=1 << 30)
    parts = [size for _, _, size in row_spans(batch, max_bytes=10_000)]
    assert len(parts) > 10
    assert whole == pytest.approx(pa.ipc.get_record_batch_size(batch), rel=0.01)
    assert sum(parts) == pytest.approx(whole, rel=0.12)


def test_row_spans_large_lists_allocate_little_memory() -> None:
    grids = pa.array([np.zeros(4_000_000, np.int8)] * 4, pa.list_(pa.int8()))
    tracemalloc.start()
    spans = row_spans(pa.record_batch({"grid": grids}), max_bytes=9_000_000)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [count for _, count, _ in spans] == [2, 2]
    assert peak_bytes < 100_000


def test_row_spans_fixed_width_rows_fill_each_span() -> None:
    batch = pa.record_batch({"a": pa.array(range(1000), pa.int64())})
    spans = row_spans(batch, max_bytes=8 * 99)
    assert [count for _, count, _ in spans] == [99] * 10 + [10]


def test_row_spans_row_above_limit_is_a_single_span() -> None:
    batch = pa.record_batch({"a": [b"x", b"y" * 5000, b"z"]})
    assert [(first, count) for first, count, _ in row_spans(batch, max_bytes=100)] == [
        (0, 1),
        (1, 1),
        (2, 1),
    ]


def test_row_spans_string_view_splits_rows_evenly() -> None:
    batch = pa.record_batch({"a": pa.array(["x" * 100] * 10, pa.string_view())})
    assert [count for _, count, _ in row_spans(batch, max_bytes=batch.nbytes // 2)] == [5, 5]
