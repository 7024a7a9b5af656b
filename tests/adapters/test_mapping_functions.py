"""Every function of the mapping language, with expected results for a few values."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.checker import Checker, Scope
from mosaico_ingest.adapters.mapping.columns import ExprType
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import parse
from mosaico_ingest.adapters.mapping.functions import SUBJECTS, functions, operators
from mosaico_ingest.adapters.mapping.functions.ros import HEADER_TYPE, STAMP_TYPE
from mosaico_ingest.ontology.registry import ontology_type

STAMP = pa.struct([("sec", pa.int32()), ("nanosec", pa.uint32())])
HEADER = pa.struct([("stamp", STAMP), ("frame_id", pa.string())])
HEADER_1 = pa.struct([("seq", pa.uint32()), ("stamp", STAMP), ("frame_id", pa.string())])
NAN, INF = math.nan, math.inf


def column(text: str, values: list[Any], type_: pa.DataType, other: list[Any] | None = None) -> list[Any]:
    """Return an expression of `x` (and `y`) for each value."""
    shape = pa.struct([("x", type_), ("y", type_)])
    rows: Any = pa.array([{"x": x, "y": y} for x, y in zip(values, other or values, strict=True)], shape)
    problems: list[Any] = []
    typed = Checker(Scope(ExprType(shape), {}), lambda *problem: problems.append(problem), text).infer(
        parse(text)
    )
    assert typed is not None, problems
    array = (
        Evaluation(rows, Envelope("", "", np.zeros(len(rows), np.int64))).evaluate(typed).close_all(len(rows))
    )
    array.validate(full=True)
    return array.to_pylist()


def near(left: Any, right: Any) -> bool:
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(near, left, right))
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(near(left[key], right[key]) for key in left)
    if isinstance(left, float) and isinstance(right, int | float):
        return math.isclose(left, right, abs_tol=1e-12) or (math.isnan(left) and math.isnan(right))
    return left == right


F8, I4, U1, TEXT, BOOL = pa.float64(), pa.int32(), pa.uint8(), pa.string(), pa.bool_()

PAIRS = pa.list_(pa.struct([("k", TEXT), ("v", I4)]))

CASES = [
    ("is_null(x)", F8, [1.0, None], [False, True]),
    ("coalesce(x, 7)", I4, [1, None], [1, 7]),
    ("coalesce(null, x)", TEXT, ["a", None], ["a", None]),
    ("null_if(x, 3)", I4, [3, 4, None], [None, 4, None]),
    ("null_if(x, '')", TEXT, ["", "a"], [None, "a"]),
    ("nan_to_null(x)", F8, [NAN, 1.0, INF, None], [None, 1.0, INF, None]),
    ("nan_to_null(x)", I4, [1, None], [1, None]),
    ("empty_to_null(x)", TEXT, ["", "a", None], [None, "a", None]),
    ("empty_to_null(x)", pa.binary(), [b"", b"a"], [None, b"a"]),
    ("empty_to_null(x)", pa.list_(F8), [[], [1.0]], [None, [1.0]]),
    ("is_nan(x)", F8, [NAN, 1.0, None], [True, False, None]),
    ("is_finite(x)", F8, [NAN, 1.0, INF], [False, True, False]),
    ("abs(x)", I4, [-3, 3], [3, 3]),
    ("abs(x)", F8, [-3.5], [3.5]),
    ("sign(x)", I4, [-3, 0, 3], [-1, 0, 1]),
    ("sign(x)", F8, [-3.5], [-1.0]),
    ("sqrt(x)", F8, [4.0, -1.0, None], [2.0, NAN, None]),
    ("exp(x)", F8, [0.0], [1.0]),
    ("log(x)", F8, [1.0, 0.0, -1.0], [0.0, -INF, NAN]),
    ("log10(x)", F8, [100.0], [2.0]),
    ("sin(x)", F8, [math.pi / 2], [1.0]),
    ("cos(x)", F8, [math.pi], [-1.0]),
    ("tan(x)", F8, [math.pi / 4], [1.0]),
    ("asin(x)", F8, [1.0, 2.0], [math.pi / 2, NAN]),
    ("acos(x)", F8, [1.0, 2.0], [0.0, NAN]),
    ("atan(x)", F8, [1.0], [math.pi / 4]),
    ("degrees(x)", F8, [math.pi], [180.0]),
    ("radians(x)", F8, [180.0], [math.pi]),
    ("floor(x)", F8, [1.5, -1.5], [1.0, -2.0]),
    ("ceil(x)", F8, [1.5, -1.5], [2.0, -1.0]),
    ("trunc(x)", F8, [1.5, -1.5], [1.0, -1.0]),
    ("round(x)", F8, [0.5, 1.5, 2.4], [0.0, 2.0, 2.0]),
    ("atan2(x, 1)", F8, [1.0], [math.pi / 4]),
    ("hypot(x, 4)", F8, [3.0], [5.0]),
    ("min(x, 2)", I4, [1, 3, None], [1, 2, None]),
    ("max(x, 2, 5)", I4, [1, 9], [5, 9]),
    ("min(x, 1)", F8, [NAN], [1.0]),
    ("clip(x, 0, 1)", F8, [-1.0, 0.5, 2.0, NAN], [0.0, 0.5, 1.0, NAN]),
    ("clip(x, 0, 10)", I4, [-1, 5, 20], [0, 5, 10]),
    ("len(x)", TEXT, ["", "żó", None], [0, 2, None]),
    ("len(x)", pa.binary(), [b"abc"], [3]),
    ("len(x)", pa.list_(I4), [[], [1, 2], None], [0, 2, None]),
    ("len(x)", pa.list_(I4, 2), [[1, 2]], [2]),
    ("sum(x)", pa.list_(I4), [[], [1, 2], [None], None], [0, 3, None, None]),
    ("sum(x)", pa.list_(pa.uint64()), [[2**63 - 2, 1]], [2**63 - 1]),
    ("sum(x)", pa.list_(pa.int64()), [[2**63 - 1, -1]], [2**63 - 2]),
    ("sum(x)", pa.list_(pa.float32()), [[], [0.5, 1.5]], [0.0, 2.0]),
    ("sum(x[] * 2)", pa.list_(I4), [[], [1, 2]], [0, 6]),
    ("mean(x)", pa.list_(I4), [[], [1, 2]], [None, 1.5]),
    ("least(x)", pa.list_(I4), [[], [3, 1, 2]], [None, 1]),
    ("greatest(x)", pa.list_(F8, 2), [[1.0, 2.0], None], [2.0, None]),
    ("norm(x)", pa.list_(I4), [[3, 4], [], [None, 1], None], [5.0, 0.0, None, None]),
    ("norm(x)", pa.list_(F8, 2), [[3.0, 4.0], None], [5.0, None]),
    ("norm(x)", pa.struct([("a", F8), ("b", I4)]), [{"a": 3.0, "b": 4}, {"a": 1.0, "b": None}, None], [5.0, None, None]),
    ("any(x)", pa.list_(BOOL), [[], [False, True], [None]], [False, True, None]),
    ("all(x[] > 0)", pa.list_(I4), [[], [1, 0], [1]], [True, False, True]),
    ("x[y[0]]", pa.list_(I4), [[1, 7], [2, 0], [0], [], None], [7, None, 0, None, None]),
    ("element(x, -1)", pa.list_(I4), [[1, 2], [], None], [2, None, None]),
    ("x[1:]", pa.list_(I4, 3), [[1, 2, 3], None], [[2, 3], None]),
    ("x[-2:-1]", pa.list_(TEXT), [["a", "b", "c"], ["a"], []], [["b"], [], []]),
    ("slice(x, 0, 1)", pa.list_(I4), [[1, 2], []], [[1], []]),
    ("filter(x, self > 1)", pa.list_(I4), [[1, 2, None, 3], [], None], [[2, 3], [], None]),
    ("filter(x, v > 1)", PAIRS, [[{"k": "a", "v": 1}, {"k": "b", "v": 2}]], [[{"k": "b", "v": 2}]]),
    ("lookup(x, k, 'b', v)", PAIRS, [[{"k": "a", "v": 1}, {"k": "b", "v": 2}, {"k": "b", "v": 3}], []], [2, None]),
    ("sort(x)", pa.list_(F8), [[2.0, NAN, None, 1.0], []], [[1.0, 2.0, NAN, None], []]),
    ("sort(x, -v)[].v", PAIRS, [[{"k": "a", "v": 1}, {"k": "b", "v": 2}]], [[2, 1]]),
    ("reverse(x)", pa.list_(I4, 2), [[1, 2], None], [[2, 1], None]),
    ("unique(x)", pa.list_(F8), [[1.0, NAN, 1.0, None, NAN, None]], [[1.0, NAN, None]]),
    ("flatten(x)", pa.list_(pa.list_(I4)), [[[1], [], None, [2, 3]], [], None], [[1, 2, 3], [], None]),
    ("zip(x, y)[].x", pa.list_(I4), [[1, 2], [], None], [[1, 2], [], None]),
    ("argmin(x)", pa.list_(I4), [[2, 1, 1], [], [None, 1], None], [1, None, None, None]),
    ("argmax(x)", pa.list_(F8), [[1.0, 3.0, 3.0], [1.0, NAN]], [1, 1]),
    ("x & 6", I4, [5, -1, None], [4, 6, None]),
    ("x | 1", I4, [4, -2, None], [5, -1, None]),
    ("x ^ 3", U1, [5], [6]),
    ("~x", I4, [0, 5], [-1, -6]),
    ("(x << 4) >> 2", I4, [1, -3, None], [4, -12, None]),
    ("bit(x, 1)", U1, [2, 5, None], [True, False, None]),
    (r"regex_replace(x, '(a)(b)', '\\2\\1')", TEXT, ["abab", "c", None], ["baba", "c", None]),
    ("format('{}={:.2f}', x, 1.5)", TEXT, ["a", None], ["a=1.50", None]),
    ("format('{:04d}/{:x}', x, x)", I4, [255, None], ["0255/ff", None]),
    ("format('{:.1f}', x)", F8, [1.25, NAN, None], ["1.2", "nan", None]),
    ("lower(x)", TEXT, ["ŻÓ"], ["żó"]),
    ("upper(x)", TEXT, ["a"], ["A"]),
    ("strip(x)", TEXT, [" a\t"], ["a"]),
    ("replace(x, 'a', 'b')", TEXT, ["aa", "c"], ["bb", "c"]),
    ("starts_with(x, 'a')", TEXT, ["ab", "b", None], [True, False, None]),
    ("ends_with(x, 'b')", TEXT, ["ab", "a"], [True, False]),
    ("contains(x, 'a.')", TEXT, ["a.b", "ab"], [True, False]),
    ("split(x, ',')", TEXT, ["a,b", ""], [["a", "b"], [""]]),
    (r"extract(x, 'v(\d+)')", TEXT, ["v12", "x", None], ["12", None, None]),
    (r"extract(x, '\((.)\)')", TEXT, ["(a)"], ["a"]),
    ("text(x)", I4, [12, None], ["12", None]),
    ("text(x)", BOOL, [True], ["true"]),
    ("number(x)", TEXT, ["1.5", " 2 ", None], [1.5, 2.0, None]),
    ("bytes(x)", pa.list_(U1, 2), [[1, 2], [3, 4]], [b"\1\2", b"\3\4"]),
    ("bytes(x)", pa.list_(U1), [[1, 2], [], None], [b"\1\2", b"", None]),
    ("bytes(x)", pa.list_(U1), [[1, None], [2]], [None, b"\2"]),
    ("bytes(x)", pa.binary(), [b"a"], [b"a"]),
    ("ros_time(x)", STAMP, [{"sec": 1, "nanosec": 2}, None], [{"seconds": 1, "nanoseconds": 2}, None]),
    ("seconds(x)", STAMP, [{"sec": -1, "nanosec": 500_000_000}], [-0.5]),
    ("nanoseconds(x)", STAMP, [{"sec": 2, "nanosec": 5}], [2_000_000_005]),
    ("nanoseconds(x)", STAMP_TYPE, [{"seconds": 2, "nanoseconds": 5}], [2_000_000_005]),
    ("time_from_ns(x)", pa.int64(), [-1, None], [{"seconds": -1, "nanoseconds": 999_999_999}, None]),
    ("yaw(quaternion_from_rpy(0.1, -0.2, x))", F8, [0.3, -3.0, None], [0.3, -3.0, None]),
    ("quaternion_from_rpy(x, 0, 0)", F8, [math.pi, None], [{"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}, None]),
    ("quaternion_from_yaw(x)", F8, [math.pi], [{"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}]),
    ("quaternion_from_yaw(x).w", F8, [0.0], [1.0]),
    ("covariance(x)", pa.list_(F8, 2), [[-1.0, 0.0], [0.0, 2.0], None], [None, [0.0, 2.0], None]),
    ("covariance(x)", pa.list_(F8), [[], [NAN], [-1.0, 2.0]], [None, None, [-1.0, 2.0]]),
    ("variance(x)", F8, [0.0, -1.0, NAN, 2.0, None], [None, None, None, 2.0, None]),
    ("x in [1, 2]", I4, [1, 3, None], [True, False, None]),
    ("x + '!'", TEXT, ["a", None], ["a!", None]),
    ("[x, 1.5]", I4, [1, None], [[1.0, 1.5], [None, 1.5]]),
    ("x[-1]", pa.list_(I4), [[1, 2], [], None], [2, None, None]),
    ("x[1]", pa.list_(I4, 2), [[1, 2], None], [2, None]),
]  # fmt: skip

FORMATS = [
    ("", "png"),
    ("jpeg", "jpeg"),
    ("JPEG", "jpeg"),
    ("h265", "hevc"),
    ("rvl", "raw"),
    ("bgr8; jpeg compressed bgr8", "jpeg"),
    ("rgb8; png compressed ", "png"),
    ("16UC1; compressedDepth png", "png"),
    ("16UC1; compressedDepth", "png"),
    ("16UC1; compressedDepth rvl", "raw"),
    ("jpeg compressed bgr8", "jpeg"),
    ("rgb8; compressed", "raw"),
    ("a b c d", "raw"),
]


@pytest.mark.parametrize(("text", "type_", "values", "expected"), CASES)
def test_function_returns_expected_values(
    text: str, type_: Any, values: list[Any], expected: list[Any]
) -> None:
    result = column(text, values, type_)
    assert all(map(near, result, expected)), result
    assert len(result) == len(expected)
    assert column(text, [], type_) == []


@pytest.mark.parametrize(("said", "stored"), FORMATS)
def test_compressed_format_returns_codec(said: str, stored: str) -> None:
    assert column("compressed_format(x)", [said, None], TEXT) == [stored, None]


def test_ros_header_empty_header_is_null() -> None:
    messages = [
        {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"},
        {"stamp": {"sec": 0, "nanosec": 1}, "frame_id": ""},
        None,
    ]
    silent, named, stamped, absent = column("ros_header(x)", messages, HEADER)
    assert silent is None
    assert absent is None
    assert named == {"timestamp": {"seconds": 0, "nanoseconds": 0}, "frame_id": "map", "sample_counter": None}
    assert stamped["timestamp"] == {"seconds": 0, "nanoseconds": 1}


def test_ros_header_ros1_seq_becomes_sample_counter() -> None:
    messages = [
        {"seq": 7, "stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"},
        {"seq": 7, "stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
    ]
    named, silent = column("ros_header(x)", messages, HEADER_1)
    assert (named["sample_counter"], silent) == (7, None)


def test_header_and_stamp_types_match_ontology() -> None:
    assert ontology_type("IMU").struct.field("header").type == HEADER_TYPE
    assert ontology_type("Time").struct == STAMP_TYPE


def test_sum_overflow_rejects_row() -> None:
    for type_ in (pa.int64(), pa.uint64()):
        with pytest.raises(RowsRejected):
            column("sum(x)", [[2**63 - 1, 1]], pa.list_(type_))


def test_functions_are_documented_and_tested() -> None:
    tested = " ".join(text for text, *_ in CASES) + " ros_header( compressed_format("
    for function in functions():
        if function.apply.__module__ == operators.__name__:
            continue
        assert function.summary.endswith("."), function.name
        assert any(function.apply.__module__ == subject.__name__ for subject in SUBJECTS)
        if not function.name.startswith("points_"):
            assert f"{function.name}(" in tested, f"{function.name} has no case"


def test_floor_division_of_null_by_zero_is_null() -> None:
    assert column("x[0] // 0", [[]], pa.list_(pa.int64())) == [None]


def test_sum_of_null_and_large_unsigned_number_is_null() -> None:
    rows = [{"w": 2**64 - 1, "x": []}, {"w": 3, "x": [4]}]
    kind = pa.struct({"w": pa.uint64(), "x": pa.list_(pa.int64())})
    assert column("x.w + x.x[0]", rows, kind) == [None, 7]


INTEGERS = st.none() | st.integers(-(2**63), 2**63 - 1) | st.integers(-8, 8)
BIT_OPERATORS: dict[str, Callable[[int, int], int | bool]] = {
    "x & y": operator.and_,
    "x | y": operator.or_,
    "x ^ y": operator.xor,
    "~x": lambda x, _: ~x,
    "x >> (y & 31)": lambda x, y: x >> (y & 31),
    "bit(x, y & 63)": lambda x, y: bool(x >> (y & 63) & 1),
    "(x & 255) << (y & 31)": lambda x, y: (x & 255) << (y & 31),
}


@pytest.mark.parametrize("text", BIT_OPERATORS)
@given(pairs=st.lists(st.tuples(INTEGERS, INTEGERS), max_size=5))
@settings(max_examples=25, deadline=None)
def test_bit_operator_equals_python(text: str, pairs: list[tuple[int | None, int | None]]) -> None:
    left, right = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    expected = [
        None if x is None or (y is None and "y" in text) else BIT_OPERATORS[text](x, y or 0) for x, y in pairs
    ]
    assert column(text, left, pa.int64(), right) == expected


@pytest.mark.parametrize(
    ("text", "value", "expected"),
    [("x >> 63", -5, -1), ("x >> 63", 2**62, 0), ("bit(x, 63)", -1, True), ("x << 63", -1, -(2**63))],
)
def test_shift_by_63_bits_equals_python(text: str, value: int, expected: int) -> None:
    assert column(text, [value], pa.int64()) == [expected]


def test_literals_of_equal_value_and_other_type_stay_apart() -> None:
    assert column("[cast(true, 'int8'), sign(1), x]", [5], pa.int64()) == [[1, 1, 5]]
    assert column("[1 / -0.0, 1 / 0.0, x]", [5.0], pa.float64()) == [[-math.inf, math.inf, 5.0]]


@pytest.mark.parametrize(
    "text", ["sort(x.a, x.b[])", "filter(x.a, x.b[] > 0)", "lookup(x.a, self, 1, x.b[])"]
)
def test_elements_with_other_number_of_values_reject_row(text: str) -> None:
    kind = pa.struct({"a": pa.list_(pa.int64()), "b": pa.list_(pa.int64())})
    assert column(text, [{"a": [1, 2], "b": [4, 3]}], kind)
    with pytest.raises(RowsRejected) as caught:
        column(text, [{"a": [1, 2], "b": [4, 3]}, {"a": [1, 2], "b": [5]}], kind)
    assert {row: rule for row, (rule, _) in caught.value.rejections.items()} == {1: "list-length"}


@pytest.mark.parametrize("text", ["x << 1", "x << 64", "x << 63", "x >> -1", "bit(x, 64)"])
def test_shift_out_of_range_rejects_row(text: str) -> None:
    with pytest.raises(RowsRejected) as caught:
        column(text, [2**62], pa.int64())
    assert caught.value.rejections[0][0] == "overflow"


@pytest.mark.parametrize(
    "text",
    [
        "format('{}')",
        "format('{:.2f}', x)",
        "format('{name}', x)",
        "format('{', x)",
        r"regex_replace(x, '(a)', '\\2')",
    ],
)
def test_wrong_format_or_replacement_is_reported(text: str) -> None:
    shape = pa.struct([("x", TEXT)])
    rules: list[str] = []
    checker = Checker(Scope(ExprType(shape), {}), lambda rule, *_: rules.append(rule), text)
    assert checker.infer(parse(text)) is None
    assert rules == ["operand-type"]


@given(values=st.lists(st.none() | st.floats(-1e6, 1e6), max_size=4), digits=st.integers(0, 5))
@settings(max_examples=25, deadline=None)
def test_format_of_floats_equals_python(values: list[float | None], digits: int) -> None:
    expected = [None if value is None else f"{value:.{digits}f} V" for value in values]
    assert column(f"format('{{:.{digits}f}} V', x)", values, F8) == expected
