"""Statistics of topics equal those of a slow calculation on all rows."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, TopicInfo
from mosaico_ingest.ontology.registry import UNITS, OntologyType, builtin_type, column_unit
from mosaico_ingest.view import columns as view_statistics
from mosaico_ingest.view.columns import ColumnStatistics, describe_topic, topic_columns, topic_timing

KIND = OntologyType(
    "Sample",
    pa.struct(
        [
            pa.field("number", pa.float64()),
            pa.field("count", pa.uint64()),
            pa.field("flag", pa.bool_()),
            pa.field("word", pa.string()),
            pa.field("blob", pa.binary()),
            pa.field("stamp", pa.struct([("sec", pa.int32()), ("nanosec", pa.uint32())])),
            pa.field("nested", pa.struct([("inner", pa.struct([("x", pa.float32())]))])),
            pa.field("items", pa.list_(pa.int16())),
            pa.field("parts", pa.list_(pa.struct([("name", pa.string()), ("size", pa.int64())]))),
        ]
    ),
)
ROW = st.fixed_dictionaries(
    {
        "number": st.none() | st.floats(-1e6, 1e6) | st.sampled_from([math.nan, math.inf]),
        "count": st.none() | st.integers(0, 2**64 - 1),
        "flag": st.none() | st.booleans(),
        "word": st.none() | st.text("ab", max_size=2),
        "blob": st.none() | st.binary(max_size=3),
        "stamp": st.none()
        | st.fixed_dictionaries({"sec": st.integers(-9, 9), "nanosec": st.integers(0, 10**9 - 1)}),
        "nested": st.none()
        | st.fixed_dictionaries(
            {"inner": st.none() | st.fixed_dictionaries({"x": st.none() | st.just(0.5)})}
        ),
        "items": st.none() | st.lists(st.none() | st.integers(-9, 9), max_size=3),
        "parts": st.none()
        | st.lists(
            st.none() | st.fixed_dictionaries({"name": st.none() | st.just("a"), "size": st.integers(0, 9)}),
            max_size=2,
        ),
    }
)


def slow_values(rows: list[dict[str, Any]], path: str) -> list[Any]:
    """Return the value of a path in each row; members of the structs in a list have one value per struct."""
    values: list[Any] = rows
    for step in path.split("."):
        name = step.removesuffix("[]")
        values = [None if value is None else value[name] for value in values]
        if step.endswith("[]"):
            values = [item for value in values for item in value or []]
    return values


def slow_items(values: list[Any]) -> Iterator[Any]:
    for value in values:
        if isinstance(value, list):
            yield from (item for item in value if item is not None)
        elif isinstance(value, bytes):
            yield len(value)
        elif isinstance(value, dict):
            yield value["sec"] * 10**9 + value["nanosec"]
        elif value is not None:
            yield value


def check(column: ColumnStatistics, rows: list[dict[str, Any]]) -> None:
    values = slow_values(rows, column.path)
    items = list(slow_items(values))
    numbers = [item for item in items if item == item]  # noqa: PLR0124 - without NaN
    finite = [item for item in numbers if isinstance(item, int | float) and math.isfinite(item)]
    distinct = len(set(numbers)) + (len(numbers) < len(items))
    assert column.nulls == values.count(None), column
    assert column.rows == len(values) - values.count(None), column
    assert column.nan == len(items) - len(numbers), column
    assert column.minimum == min(numbers, default=None), column
    assert column.maximum == max(numbers, default=None), column
    assert column.distinct == (distinct or None), column
    lengths = [len(value) for value in values if isinstance(value, list)]
    assert column.lengths == ((min(lengths), max(lengths)) if lengths else None), column
    if column.is_time or not finite:
        assert column.mean is None, column
    else:
        assert column.mean == pytest.approx(statistics.fmean(finite), rel=1e-9, abs=1e-9), column


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(rows=st.lists(ROW, min_size=1, max_size=20), size=st.integers(1, 9))
def test_describe_topic_equals_calculation_on_all_rows(
    rows: list[dict[str, Any]], size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = pa.Table.from_pylist(
        [{"timestamp_ns": at, **row} for at, row in enumerate(rows)], topic_schema(KIND)
    )
    topic = TopicInfo("made", "/t", "", KIND, table.schema, {}, 0, ())
    monkeypatch.setattr(view_statistics, "scan", lambda *_: iter(table.to_batches(max_chunksize=size)))
    described = describe_topic(topic)
    assert [column.path for column in described.columns] == [c.path for c in topic_columns(table.schema)]
    for column in described.columns[1:]:
        check(column, table.to_pylist())


def test_describe_topic_has_units_and_times_of_quickstart(quickstart: Store) -> None:
    topic = quickstart.topic("quickstart_drive", "imu")
    described = describe_topic(topic)
    columns = {column.path: column for column in described.columns}
    assert columns["acceleration.z"].unit == "m/s²"
    assert columns["acceleration.covariance"].unit == ""
    assert columns["timestamp_ns"].minimum == topic.start_ns
    assert columns["header.timestamp"].is_time
    assert described.timing.rows == 1000
    assert described.timing.rate_hz == pytest.approx(100)
    assert described.timing.timeline is not None
    assert described.timing.timeline.jitter_ns == pytest.approx(0, abs=1000)


def test_describe_topic_large_binary_column_is_not_read(
    quickstart: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = quickstart.topic("quickstart_drive", "camera/image_raw/compressed")
    (exact,) = (column for column in describe_topic(topic).columns if column.path == "data")
    monkeypatch.setattr(view_statistics, "MAX_BINARY_BYTES", 1000)
    (estimate,) = (column for column in describe_topic(topic).columns if column.path == "data")
    assert (estimate.minimum, estimate.rows, estimate.nulls) == (None, None, 0)
    assert estimate.mean == pytest.approx(exact.mean, rel=0.02)


def test_describe_topic_many_distinct_values_stops_counting(
    quickstart: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_statistics, "MAX_DISTINCT", 10)
    columns = {c.path: c for c in describe_topic(quickstart.topic("quickstart_drive", "imu")).columns}
    assert columns["acceleration.x"].distinct is None
    assert columns["acceleration.z"].distinct == 1


def test_topic_timing_finds_gaps_by_median_interval(make_store: Any) -> None:
    kind = OntologyType("Number", pa.struct([("value", pa.int64())]))
    times = [*range(0, 1000, 10), *range(2000, 3000, 10)]
    rows = [{"timestamp_ns": at * 10**6, "value": at} for at in times]
    timing = topic_timing(make_store({"/t": (kind, rows)}).topic("made", "t"))
    intervals = [
        (after - before) * 10**6 for before, after in pairwise(times) if (before, after) != (990, 2000)
    ]
    assert timing.rate_hz == pytest.approx(199 / 2.99)
    assert timing.timeline is not None
    assert timing.timeline.jitter_ns == pytest.approx(statistics.pstdev(intervals))
    assert [(gap.start_ns, gap.end_ns) for gap in timing.timeline.gaps] == [(990 * 10**6, 2000 * 10**6)]


@pytest.mark.parametrize("times", [[], [5], [5, 5]])
def test_topic_timing_without_interval_has_no_rate(make_store: Any, times: list[int]) -> None:
    kind = OntologyType("Number", pa.struct([("value", pa.int64())]))
    rows = [{"timestamp_ns": at, "value": at} for at in times]
    timing = topic_timing(make_store({"/t": (kind, rows)}).topic("made", "t"))
    assert (timing.rows, timing.rate_hz) == (len(times), None)
    assert timing.timeline is None or timing.timeline.jitter_ns is None


@pytest.mark.parametrize("tag", UNITS)
def test_units_name_columns_of_the_ontology(tag: str) -> None:
    paths = {column.path.replace("[]", "") for column in topic_columns(pa.schema(builtin_type(tag).struct))}
    for path in UNITS[tag]:
        assert any(known == path or known.startswith(f"{path}.") for known in paths), path


@pytest.mark.parametrize(
    ("path", "unit"),
    [
        ("position.x", "m"),
        ("position.covariance", ""),
        ("orientation.w", ""),
        ("header.frame_id", ""),
    ],
)
def test_column_unit_applies_to_components_of_struct(path: str, unit: str) -> None:
    assert column_unit("Pose", path) == unit
