"""Alignment of topics in time, compared with one row at a time in plain Python."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mosaico_ingest
from mosaico_ingest import Store, align
from mosaico_ingest.errors import ViewError

TIMES = st.lists(st.integers(0, 40), max_size=12)
INT64 = st.integers(-(2**63), 2**63 - 1)
Row = tuple[int, "float | None", str]


def table_of(rows: Sequence[Row]) -> pa.Table:
    """Return rows in two chunks, with a number in a struct."""
    split = len(rows) // 2
    schema = pa.schema(
        {
            "timestamp_ns": pa.int64(),
            "position": pa.struct({"x": pa.float64(), "n": pa.int32()}),
            "label": pa.string(),
        }
    )
    batches = [
        pa.RecordBatch.from_pylist(
            [
                {"timestamp_ns": time, "position": {"x": x, "n": None if x is None else 3}, "label": label}
                for time, x, label in part
            ],
            schema,
        )
        for part in (rows[:split], rows[split:])
    ]
    return pa.Table.from_batches(batches, schema)


def row_at(rows: Sequence[Row], time: int, method: str, limit: int) -> Row | None:
    """Return the last row at or before a time, or the nearest row, preferring the earlier of two."""
    before = [row for row in rows if row[0] <= time][-1:]
    after = [row for row in rows if row[0] > time][:1] if method == "nearest" else []
    near = [row for row in (*before, *after) if abs(row[0] - time) <= limit]
    return min(near, key=lambda row: abs(row[0] - time), default=None)


def number_at(rows: Sequence[Row], time: int, limit: int) -> float | None:
    before = [row for row in rows if row[0] <= time][-1:]
    after = [row for row in rows if row[0] > time][:1]
    if not before or time - before[0][0] > limit:
        return None
    (start, low, _) = before[0]
    if start == time:
        return low
    if not after or after[0][0] - time > limit:
        return None
    (end, high, _) = after[0]
    if low is None or high is None:
        return None
    weight = (time - start) / (end - start)
    return low * (1 - weight) + high * weight


ROWS = st.lists(
    st.tuples(st.integers(0, 40), st.none() | st.floats(-1e6, 1e6), st.text("ab", min_size=1, max_size=1)),
    max_size=10,
).map(lambda rows: sorted(rows, key=lambda row: row[0]))


@given(
    rows=ROWS,
    times=TIMES,
    method=st.sampled_from(["backward", "nearest", "linear"]),
    limit=st.none() | st.integers(0, 12),
)
def test_align_equals_search_row_by_row(
    rows: list[Row], times: list[int], method: Any, limit: int | None
) -> None:
    aligned = align({"a": table_of(rows)}, times, method=method, tolerance=limit).to_pylist()
    furthest = 2**63 if limit is None else limit
    assert [row["timestamp_ns"] for row in aligned] == times
    for time, row in zip(times, aligned, strict=True):
        expected = row_at(rows, time, method, furthest)
        assert (row["a.timestamp_ns"], row["a.label"]) == (
            (None, None) if expected is None else (expected[0], expected[2])
        )
        if method == "linear":
            assert row["a.position.x"] == number_at(rows, time, furthest)
        else:
            assert row["a.position.x"] == (None if expected is None else expected[1])


@given(times=st.lists(INT64, min_size=1, max_size=6), at=st.lists(INT64, max_size=6))
def test_align_times_of_the_full_range_find_the_nearest_row(times: list[int], at: list[int]) -> None:
    table = pa.table({"timestamp_ns": pa.array(sorted(times), pa.int64())})
    times = align({"a": table}, at, method="nearest").column("a.timestamp_ns").to_pylist()
    assert [abs(time - row) for time, row in zip(at, times, strict=True)] == [
        min(abs(time - own) for own in times) for time in at
    ]


def test_align_linear_keeps_float_types_and_returns_integers_as_float64() -> None:
    columns = {"half": pa.float16(), "single": pa.float32(), "small": pa.uint8(), "flag": pa.bool_()}
    values = {name: pa.array(np.array([0, 1], kind.to_pandas_dtype())) for name, kind in columns.items()}
    table = pa.table({"timestamp_ns": pa.array([0, 10], pa.int64()), **values})
    row = align({"a": table}, [5], method="linear")
    types = [str(row.schema.field(f"a.{name}").type) for name in columns]
    assert types == ["halffloat", "float", "double", "bool"]
    assert [row.column(f"a.{name}")[0].as_py() for name in columns] == [0.5, 0.5, 0.5, False]


def test_align_infinite_neighbors_make_nan_only_between_rows() -> None:
    table = pa.table({"timestamp_ns": pa.array([0, 10], pa.int64()), "x": [math.inf, -math.inf]})
    values = align({"a": table}, [0, 5, 10], method="linear").column("a.x").to_pylist()
    assert values[0::2] == [math.inf, -math.inf]
    assert math.isnan(values[1])


def test_align_sorts_tables_and_accepts_a_topic_as_times() -> None:
    one = pa.table({"timestamp_ns": pa.array([30, 10, 20], pa.int64()), "x": [3, 1, 2]})
    two = pa.table({"timestamp_ns": pa.array([12, 25], pa.int64()), "y": [7, 8]})
    aligned = align({"one": one, "two": two}, "two")
    assert aligned.to_pydict() == {
        "timestamp_ns": [12, 25],
        "one.timestamp_ns": [10, 20],
        "one.x": [1, 2],
        "two.timestamp_ns": [12, 25],
        "two.y": [7, 8],
    }


def test_align_rate_covers_the_time_in_which_all_topics_have_rows() -> None:
    one = pa.table({"timestamp_ns": pa.array([0, 10**9], pa.int64())})
    two = pa.table({"timestamp_ns": pa.array([4 * 10**8, 2 * 10**9], pa.int64())})
    aligned = align({"one": one, "two": two}, "5 Hz").column("timestamp_ns").to_pylist()
    assert aligned == [400_000_000, 600_000_000, 800_000_000, 1_000_000_000]
    empty = pa.table({"timestamp_ns": pa.array([], pa.int64())})
    assert align({"one": one, "none": empty}, "5 Hz").num_rows == 0
    assert align({"one": one, "none": empty}, "one").column("none.timestamp_ns").null_count == 2


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"at": "imo"}, "'imo' is neither a topic nor a rate — the nearest is imu"),
        ({"at": [0], "method": "forward"}, "'forward'"),
        ({"at": [0], "tolerance": "1 fortnight"}, "is not a duration"),
        ({"at": [0], "tolerance": -1}, "the tolerance is -1"),
        ({"at": [0], "topics": {}}, "no topic"),
        ({"at": [0], "topics": {"imu": pa.table({"x": [1]})}}, "no column timestamp_ns"),
    ],
)
def test_align_invalid_argument_raises(arguments: dict[str, Any], text: str) -> None:
    topics = {"imu": pa.table({"timestamp_ns": pa.array([0], pa.int64())})}
    with pytest.raises(ViewError) as error:
        align(**{"topics": topics, **arguments})
    assert text in str(error.value)


def test_align_topics_of_a_store_have_one_row_per_image(quickstart: Store) -> None:
    drive = quickstart.sequence("quickstart_drive")
    image, imu = drive.topic("/camera/image_raw/compressed"), drive.topic("/imu")
    aligned = mosaico_ingest.align(
        {"image": image, "imu": imu.to_arrow(columns=["acceleration.x"])}, at="image", tolerance="20 ms"
    )
    assert aligned.num_rows == image.rows
    assert aligned.column("image.data").null_count == 0
    assert aligned.column("imu.acceleration.x").null_count == 0
