"""Functions of lists, `let`, `rows`, `drop_when` and `outputs`, compared with plain Python over single messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.adapters.builtin import find_builtin
from mosaico_ingest.adapters.mapping.checker import Checker, Scope
from mosaico_ingest.adapters.mapping.columns import ExprType
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import parse
from mosaico_ingest.adapters.mapping.loader import MappingAdapter, load_adapter
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

CELL = pa.struct([("key", pa.string()), ("value", pa.float64())])
MESSAGE = pa.struct(
    [
        ("name", pa.list_(pa.string())),
        ("number", pa.list_(pa.float64())),
        ("fixed", pa.list_(pa.int32(), 3)),
        ("cells", pa.list_(CELL)),
        ("nested", pa.list_(pa.list_(pa.int16()))),
        ("i", pa.int8()),
        ("j", pa.int8()),
        ("want", pa.string()),
    ]
)
KEYS = st.none() | st.sampled_from(["a", "b", "c"])
NUMBERS = st.none() | st.sampled_from([-1.0, -0.0, 0.0, 2.5, math.inf, math.nan])
INTEGERS = st.none() | st.integers(-4, 4)
ROWS = st.lists(
    st.fixed_dictionaries(
        {
            "name": st.none() | st.lists(KEYS, max_size=4),
            "number": st.none() | st.lists(NUMBERS, max_size=4),
            "fixed": st.none() | st.lists(INTEGERS, min_size=3, max_size=3),
            "cells": st.none()
            | st.lists(st.none() | st.fixed_dictionaries({"key": KEYS, "value": NUMBERS}), max_size=4),
            "nested": st.none() | st.lists(st.none() | st.lists(st.integers(0, 3), max_size=3), max_size=3),
            "i": INTEGERS,
            "j": INTEGERS,
            "want": KEYS,
        }
    ),
    max_size=5,
)
REJECTED = "rejected"
"""The value of a rejected row."""


def ascending(values: list[Any]) -> list[Any]:
    numbers = [value for value in values if value is not None and not math.isnan(value)]
    nans = [value for value in values if value is not None and math.isnan(value)]
    return sorted(numbers) + nans + [value for value in values if value is None]


def distinct(values: list[Any]) -> list[Any]:
    result: list[Any] = []
    for value in values:
        if not any(same(value, other) for other in result):
            result.append(value)
    return result


def position(values: list[Any], pick: Callable[..., Any]) -> int | None:
    if not values or None in values:
        return None
    nans = [at for at, value in enumerate(values) if math.isnan(value)]
    return nans[0] if nans else values.index(pick(values))


def field(cell: dict[str, Any] | None, name: str) -> Any:
    return None if cell is None else cell[name]


def at(values: list[Any] | None, index: int | None) -> Any:
    if values is None or index is None or not -len(values) <= index < len(values):
        return None
    return values[index]


def zipped(row: dict[str, Any]) -> Any:
    if row["name"] is None or row["number"] is None:
        return None
    if len(row["name"]) != len(row["number"]):
        return REJECTED
    return [{"name": n, "number": v} for n, v in zip(row["name"], row["number"], strict=True)]


def of(name: str, run: Callable[[list[Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda row: None if row[name] is None else run(row[name])


ORACLES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "filter(number, self > 0)": of("number", lambda v: [x for x in v if x is not None and x > 0]),
    "filter(cells, key == want)": lambda row: None
    if row["cells"] is None
    else [c for c in row["cells"] if c is not None and c["key"] is not None and c["key"] == row["want"]],
    "filter(fixed, self != 2)": of("fixed", lambda v: [x for x in v if x is not None and x != 2]),
    "lookup(cells, key, want, value)": lambda row: next(
        (c["value"] for c in row["cells"] or () if c is not None and c["key"] is not None and c["key"] == row["want"]),
        None,
    ),
    "sort(number)": of("number", ascending),
    "sort(name)": of("name", lambda v: sorted(x for x in v if x is not None) + [x for x in v if x is None]),
    "sort(fixed, -self)": of(
        "fixed", lambda v: sorted((x for x in v if x is not None), reverse=True) + [x for x in v if x is None]
    ),
    "reverse(nested)": of("nested", lambda v: v[::-1]),
    "reverse(fixed)": of("fixed", lambda v: v[::-1]),
    "unique(number)": of("number", distinct),
    "unique(name)": of("name", distinct),
    "flatten(nested)": of("nested", lambda v: [x for inner in v for x in inner or ()]),
    "argmax(number)": of("number", lambda v: position(v, max)),
    "argmin(fixed)": of("fixed", lambda v: position(v, min)),
    "zip(name, number)": zipped,
    "number[i]": lambda row: at(row["number"], row["i"]),
    "fixed[i]": lambda row: at(row["fixed"], row["i"]),
    "cells[i].value": lambda row: field(at(row["cells"], row["i"]), "value"),
    "name[i:j]": lambda row: None
    if None in {row["i"], row["j"]} or row["name"] is None
    else row["name"][row["i"] : row["j"]],
    "fixed[1:]": of("fixed", lambda v: v[1:]),
    "nested[:-1]": of("nested", lambda v: v[:-1]),
    "len(unique(filter(name, not is_null(self))))": of("name", lambda v: len({x for x in v if x is not None})),
    "sum(filter(cells, value > 0)[].value)": of(
        "cells",
        lambda v: math.fsum(c["value"] for c in v if c is not None and c["value"] is not None and c["value"] > 0),
    ),
}  # fmt: skip


def same(left: Any, right: Any) -> bool:
    if isinstance(left, dict) and isinstance(right, dict):
        return left.keys() == right.keys() and all(same(left[key], right[key]) for key in left)
    if isinstance(left, list) and isinstance(right, list):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, float) and isinstance(right, float) and math.isnan(left):
        return math.isnan(right)
    return left == right


def over_columns(text: str, rows: list[dict[str, Any]]) -> list[Any]:
    problems: list[Any] = []
    scope = Scope(ExprType(MESSAGE), {})
    typed = Checker(scope, lambda *problem: problems.append(problem), text).infer(parse(text))
    assert typed is not None, problems
    values: list[Any] = [REJECTED] * len(rows)
    index = np.arange(len(rows))
    array: Any = pa.array(rows, MESSAGE)
    while True:
        try:
            result = Evaluation(array, Envelope("", "", np.zeros(len(array), np.int64))).evaluate(typed)
        except RowsRejected as error:
            good = np.ones(len(array), bool)
            good[list(error.rejections)] = False
            array, index = array.filter(pa.array(good)), index[good]
            continue
        closed = result.close_all(len(array))
        closed.validate(full=True)
        for row, value in zip(index.tolist(), closed.to_pylist(), strict=True):
            values[row] = value
        return values


@pytest.mark.parametrize("text", ORACLES)
@settings(max_examples=25, deadline=None)
@given(rows=ROWS, size=st.integers(1, 3))
def test_list_function_equals_plain_python_in_any_batch_size(
    text: str, rows: list[dict[str, Any]], size: int
) -> None:
    expected = [ORACLES[text](row) for row in rows]
    assert same(over_columns(text, rows), expected)
    batches = [over_columns(text, rows[start : start + size]) for start in range(0, len(rows), size)]
    assert same([value for batch in batches for value in batch], expected)


# --- files ----------------------------------------------------------------------------------------------------

STATUS = """version: 1
adapter: StatusAdapter
ros_type: acme_msgs/msg/Status
{body}
definition: |
  string name
  int32 scale
  acme_msgs/Cell[] cells
  ================================================================================
  MSG: acme_msgs/Cell
  string key
  int32 value
"""
ROWS_BODY = """parameters: {least: 0}
let:
  source: name
  factor: scale * 2
drop_when: name == 'skip'
rows: filter(cells, value >= least)[]
ontology: {tag: Entry, fields: {source: string, key: string, product: int32, time: int64, place: string}}
fields:
  source: source
  key: key
  product: cast(value * factor)
  time: message.log_time
  place: message.topic"""
OUTPUTS_BODY = """let: {factor: scale * 2}
drop_when: name == 'skip'
outputs:
  entries:
    rows: cells[]
    ontology: {tag: Entry, fields: {key: string, product: int32}}
    fields: {key: key, product: cast(value * factor)}
  summary:
    drop_when: len(cells) == 0
    ontology: {tag: Summary, fields: {name: string, count: int64}}
    fields: {name: name, count: len(cells)}"""


def bound(body: str, **parameters: Any) -> MappingAdapter:
    spec = load_adapter(STATUS.format(body=body), file="status.yaml").with_parameters(parameters)
    definition = definition_of(spec.model.definition or "")
    return spec.bind(definition, ros_shape(definition))


def definition_of(text: str) -> Definition:
    return TypeResolver().resolve("acme_msgs/msg/Status", Embedded("ros2msg", text), ros_version=2)


def adapt(adapter: MappingAdapter, messages: list[dict[str, Any]]) -> Adapted:
    shape = ros_shape(definition_of(load_adapter(STATUS.format(body=ROWS_BODY)).model.definition or ""))
    times = np.arange(len(messages), dtype=np.int64) + 1000
    return adapter.adapt(pa.array(messages, shape), Envelope("/status", "acme_msgs/msg/Status", times))


MESSAGES = st.lists(
    st.fixed_dictionaries(
        {
            "name": st.sampled_from(["a", "b", "skip"]),
            "scale": st.sampled_from([0, 1, -3, 2**30]),
            "cells": st.lists(
                st.fixed_dictionaries({"key": st.sampled_from(["x", "y"]), "value": st.integers(-3, 3)}),
                max_size=3,
            ),
        }
    ),
    max_size=6,
)


def fits(message: dict[str, Any], cells: list[dict[str, Any]]) -> bool:
    return all(-(2**31) <= cell["value"] * message["scale"] * 2 < 2**31 for cell in cells)


@settings(max_examples=60, deadline=None)
@given(messages=MESSAGES, least=st.integers(-2, 2))
def test_rows_equal_plain_python(messages: list[dict[str, Any]], least: int) -> None:
    adapted = adapt(bound(ROWS_BODY, least=least), messages)
    rows: list[tuple[int, dict[str, Any]]] = []
    rejected: list[int] = []
    dropped: dict[str, list[int]] = {"drop_when": [], "rows": []}
    for at_, message in enumerate(messages):
        cells = [cell for cell in message["cells"] if cell["value"] >= least]
        if message["name"] == "skip":
            dropped["drop_when"].append(at_)
        elif not fits(message, cells):
            rejected.append(at_)
        elif not cells:
            dropped["rows"].append(at_)
        rows += [
            (
                at_,
                {
                    "source": message["name"],
                    "key": cell["key"],
                    "product": cell["value"] * message["scale"] * 2,
                    "time": 1000 + at_,
                    "place": "/status",
                },
            )
            for cell in cells
            if message["name"] != "skip" and fits(message, cells)
        ]
    values: Any = adapted.rows
    assert list(zip(adapted.index.tolist(), values.to_pylist(), strict=True)) == rows
    assert [failure.row for failure in adapted.failures] == rejected
    assert {rule: at_.tolist() for rule, at_ in adapted.dropped.items()} == {
        k: v for k, v in dropped.items() if v
    }
    assert len(adapted.messages) + len(rejected) + sum(map(len, dropped.values())) == len(messages)


@settings(max_examples=40, deadline=None)
@given(messages=MESSAGES)
def test_outputs_write_drop_or_reject_each_message_together(messages: list[dict[str, Any]]) -> None:
    adapted = adapt(bound(OUTPUTS_BODY), messages)
    kept = [
        at_ for at_, m in enumerate(messages) if m["name"] != "skip" and m["cells"] and fits(m, m["cells"])
    ]
    [summary] = adapted.others
    values: Any = summary.rows
    assert summary.index.tolist() == kept
    assert values.to_pylist() == [
        {"name": messages[k]["name"], "count": len(messages[k]["cells"])} for k in kept
    ]
    assert adapted.index.tolist() == [k for k in kept for _ in messages[k]["cells"]]
    assert adapted.messages.tolist() == kept
    dropped = sum(len(at_) for at_ in adapted.dropped.values())
    assert len(kept) + dropped + len(adapted.failures) == len(messages)


@pytest.mark.parametrize(
    ("body", "rule", "line", "part"),
    [
        (ROWS_BODY.replace("let:", "let:\n  self: name"), "adapter-file", 6, "'self'"),
        (ROWS_BODY.replace("drop_when: name == 'skip'", "drop_when: name"), "operand-type", 8, "drop_when"),
        (ROWS_BODY.replace("rows: filter(cells, value >= least)[]", "rows: cells"), "operand-type", 9, "rows"),
        (ROWS_BODY.replace("factor: scale * 2", "factor: scal * 2"), "unknown-field", 7, "'scal'"),
        (ROWS_BODY.replace("factor: scale * 2", "factor: cast(scale)"), "function-arguments", 7, "cast"),
        (ROWS_BODY.replace("key: key", "key: cells"), "unknown-field", 13, "'cells'"),
        (ROWS_BODY + "\noutputs: {a: {ontology: String, fields: {data: name}}}", "conflicting-keys", 10, "ontology"),
        ("drop_when: name == ''", "missing-key", 2, "'ontology'"),
        (OUTPUTS_BODY.replace("name: name,", "nam: name,"), "unknown-column", 14, "'nam'"),
    ],
)  # fmt: skip
def test_mistake_in_bindings_rows_and_outputs_is_located(body: str, rule: str, line: int, part: str) -> None:
    with pytest.raises(AdapterError) as caught:
        bound(body)
    finding = caught.value.findings[0]
    assert finding.rule == rule
    assert finding.span is not None
    assert (finding.span.line, part in finding.message) == (line, True), finding


@pytest.mark.parametrize(("name", "value"), [("lest", 1), ("least", "1"), ("least", 1.5), ("least", True)])
def test_parameter_of_unknown_name_or_type_raises(name: str, value: Any) -> None:
    with pytest.raises(AdapterError, match="parameter"):
        bound(ROWS_BODY, **{name: value})


def test_use_of_adapter_with_several_rows_is_reported() -> None:
    class Lookup:
        def __call__(self, name: str) -> Any:
            return (
                load_adapter(STATUS.format(body=ROWS_BODY)) if name == "StatusAdapter" else find_builtin(name)
            )

        def names(self) -> list[str]:
            return ["StatusAdapter"]

    outer = """version: 1
adapter: OuterAdapter
ros_type: acme_msgs/msg/Outer
ontology: {tag: Outer, fields: {inner: {fields: {key: string}}}}
fields: {inner: {use: StatusAdapter, of: status}}
definition: |
  acme_msgs/Status status
  ================================================================================
  MSG: acme_msgs/Status
  string name
  int32 scale
  acme_msgs/Cell[] cells
  ================================================================================
  MSG: acme_msgs/Cell
  string key
  int32 value
"""
    spec = load_adapter(outer, adapters=Lookup())
    definition = TypeResolver().resolve(
        "acme_msgs/msg/Outer", Embedded("ros2msg", spec.model.definition or ""), ros_version=2
    )
    with pytest.raises(AdapterError) as caught:
        spec.bind(definition, ros_shape(definition))
    assert caught.value.findings[0].rule == "type-mismatch"
