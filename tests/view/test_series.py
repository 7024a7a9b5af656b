"""Series keep all extreme values, select fields and items, and make charts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ViewError
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.view.series import Series, _Envelope, chart_lines, plot_fields, read_series, write_chart

READS_NULL_FIXED_LISTS = pytest.mark.skipif(
    int(pa.__version__.partition(".")[0]) < 26,
    reason="pyarrow 25 cannot read null lists of fixed size from Parquet",
)
KIND = OntologyType(
    "Sample",
    pa.struct(
        [
            ("flag", pa.bool_()),
            ("text", pa.string()),
            ("lists", pa.list_(pa.float64())),
            ("fixed", pa.list_(pa.float32(), 2)),
            ("stamp", pa.struct([("sec", pa.int32()), ("nanosec", pa.uint32())])),
        ]
    ),
)
ROWS = [
    {"flag": True, "lists": [1.0, 2.0], "fixed": [1.0, 2.0], "stamp": {"sec": 2, "nanosec": 5 * 10**8}},
    {"flag": None, "lists": [3.0], "fixed": None, "stamp": None},
    {"flag": False, "lists": None, "fixed": [5.0, 6.0], "stamp": {"sec": 4, "nanosec": 0}},
]


@pytest.fixture
def sample(make_store: Any) -> Any:
    rows = [{"timestamp_ns": at, "text": "a", **row} for at, row in enumerate(ROWS)]
    return make_store({"/t": (KIND, rows)}).topic("made", "t")


def same(left: Any, right: list[float]) -> bool:
    return np.array_equal(left, np.array(right, float), equal_nan=True)


@pytest.mark.parametrize(
    ("field", "labels", "values"),
    [
        ("flag", ["flag"], [[1, math.nan, 0]]),
        ("lists[1]", ["lists[1]"], [[2, math.nan, math.nan]]),
        ("lists", ["lists[0]", "lists[1]"], [[1, 3, math.nan], [2, math.nan, math.nan]]),
        pytest.param(
            "fixed",
            ["fixed[0]", "fixed[1]"],
            [[1, math.nan, 5], [2, math.nan, 6]],
            marks=READS_NULL_FIXED_LISTS,
        ),
        pytest.param("fixed[5]", ["fixed[5]"], [[math.nan] * 3], marks=READS_NULL_FIXED_LISTS),
        ("stamp", ["stamp"], [[2.5, math.nan, 4]]),
    ],
)
def test_read_series_selects_fields_and_items(
    sample: Any, field: str, labels: list[str], values: list[list[float]]
) -> None:
    series = read_series(sample, [field])
    assert [each.label for each in series] == labels
    assert all(same(each.values, expected) for each, expected in zip(series, values, strict=True))
    assert series[0].times_ns.tolist() == [0, 1, 2]


@pytest.mark.parametrize("field", ["text", "nothing", "lists[x]", "timestamp"])
def test_read_series_field_without_numbers_raises_view_error(sample: Any, field: str) -> None:
    with pytest.raises(ViewError):
        read_series(sample, [field])


def test_read_series_struct_stands_for_its_measurements(quickstart: Store) -> None:
    series = read_series(quickstart.topic("quickstart_drive", "imu"), ["acceleration"], max_points=100)
    assert [(each.label, each.unit) for each in series] == [
        (f"acceleration.{axis}", "m/s²") for axis in "xyz"
    ]
    assert all(90 <= len(each.values) <= 110 for each in series[:2])


def test_read_series_reads_time_range(quickstart: Store) -> None:
    topic = quickstart.topic("quickstart_drive", "imu")
    assert topic.start_ns is not None
    (series,) = read_series(
        topic, ["acceleration.x"], start_ns=topic.start_ns + 10**9, end_ns=topic.start_ns + 2 * 10**9
    )
    assert len(series.times_ns) == 100


@given(
    values=st.lists(st.floats(-9, 9) | st.just(math.nan), max_size=60),
    group=st.integers(1, 12),
    size=st.integers(1, 17),
)
def test_envelope_keeps_extremes_of_each_group(values: list[float], group: int, size: int) -> None:
    envelope = _Envelope(group)
    for start in range(0, len(values), size):
        part = np.array(values[start : start + size])
        envelope.add(np.arange(start, start + len(part)), part)
    times, kept = envelope.points()
    assert same(kept, [values[at] for at in times])
    assert (np.diff(times) > 0).all()
    assert len(times) <= 2 * -(-len(values) // max(2, group)) + group
    for start in range(0, len(values), group):
        finite = [value for value in values[start : start + group] if value == value]  # noqa: PLR0124 - no NaN
        if finite:
            inside = kept[(times >= start) & (times < start + group)]
            assert np.nanmin(inside) == min(finite)
            assert np.nanmax(inside) == max(finite)


def test_plot_fields_are_measurements(quickstart: Store) -> None:
    fields = {topic.name: plot_fields(topic) for topic in quickstart.sequence("quickstart_drive").topics}
    assert fields["/imu"][0] == "acceleration.x"
    assert fields["/gps/fix"][:3] == ["position.x", "position.y", "position.z"]
    assert fields["/joint_states"] == ["positions", "velocities", "efforts"]
    assert fields["/tf"] == []
    assert not any("covariance" in name or "header" in name for names in fields.values() for name in names)


def line(values: list[float]) -> Series:
    return Series("v", "", np.arange(len(values)) * 10**9, np.array(values, float))


def test_chart_lines_rise_from_bottom_left_to_top_right() -> None:
    lines = chart_lines([line([0, 1, 2, 3])], width=40, height=8)
    assert lines[0].text.strip()
    assert lines[0].text[:15].strip() == ""
    assert lines[7].text[-15:].strip() == ""
    assert lines[0].label.strip() == "3 ┤"
    assert lines[7].label.strip() == "0 ┤"
    assert all(len(each.label) + len(each.text) <= 40 for each in lines)


@pytest.mark.parametrize("values", [[5.0], [5.0, 5.0], [math.nan, 1.0, math.inf], [-0.0]])
def test_chart_lines_of_few_values_draw_them(values: list[float]) -> None:
    assert any(each.text.strip() for each in chart_lines([line(values)], width=30, height=5)[:-1])


@pytest.mark.parametrize("values", [[], [math.nan]])
def test_chart_lines_without_finite_values_are_empty(values: list[float]) -> None:
    assert chart_lines([line(values)], width=30, height=5) == []


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_write_chart_writes_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"chart{suffix}"
    write_chart([line([1, 2]), line([])], path, title="t")
    if suffix == ".png":
        with Image.open(path) as picture:
            assert picture.size[0] == 1200
    else:
        assert "<svg" in path.read_text()
    with pytest.raises(ViewError):
        write_chart([line([1])], tmp_path / "chart.xyz", title="t")
