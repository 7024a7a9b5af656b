"""The documented handling of nulls by the functions of lists: the page lists each function, and each row is correct."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.checker import Checker, Scope
from mosaico_ingest.adapters.mapping.columns import ExprType
from mosaico_ingest.adapters.mapping.evaluator import Evaluation
from mosaico_ingest.adapters.mapping.expressions import parse
from mosaico_ingest.adapters.mapping.functions import functions

SECTION = (
    (Path(__file__).parents[2] / "docs" / "mapping.md").read_text("utf-8").split("### Nulls in lists")[1]
)
INTRODUCTION, _, REST = SECTION.partition("<!-- nulls: checked by the tests -->")
TABLE = re.findall(r"^\| `(.+?)` \| `(.+?)` \| `(.+?)` \| `(.+?)` \|$", REST.split("## ")[0], re.MULTILINE)
VALUES = {
    name: values
    for text in re.findall(r"`(\w+: \[[^`]+\])`", INTRODUCTION)
    for name, values in yaml.safe_load(text).items()
}
MESSAGE = pa.struct(
    [
        ("numbers", pa.list_(pa.float64())),
        ("octets", pa.list_(pa.uint8())),
        ("flags", pa.list_(pa.bool_())),
        ("lists", pa.list_(pa.list_(pa.float64()))),
        ("cells", pa.list_(pa.struct([("name", pa.string()), ("volts", pa.float64())]))),
    ]
)


def value_of(text: str, row: dict[str, Any]) -> Any:
    problems: list[Any] = []
    scope = Scope(ExprType(MESSAGE), {})
    typed = Checker(scope, lambda *problem: problems.append(problem), text).infer(parse(text))
    assert typed is not None, problems
    message: Any = pa.array([row], MESSAGE)
    column = Evaluation(message, Envelope("", "", np.zeros(1, np.int64))).evaluate(typed).close_all(1)
    column.validate(full=True)
    [value] = column.to_pylist()
    return value.decode() if isinstance(value, bytes) else value


def takes_only_lists(accepts: Any) -> bool:
    plain = (pa.float64(), pa.bool_(), pa.struct([("sec", pa.int32())]))
    lists = (*(field.type for field in MESSAGE), pa.list_(pa.string()), pa.list_(pa.float64(), 9))
    return any(accepts(ExprType(type_)) for type_ in lists) and not any(
        accepts(ExprType(type_)) for type_ in plain
    )


def test_null_table_uses_each_function_of_lists() -> None:
    documented = set(re.findall(r"(\w+)\(", " ".join(call for call, *_ in TABLE)))
    expected = {
        function.name
        for function in functions()
        if function.parameter_types and takes_only_lists(function.parameter_types[0].accepts)
    }
    assert {"norm", "sort", "zip", "covariance"} <= documented
    assert expected - documented == set()
    assert VALUES.keys() == {field.name for field in MESSAGE}


@pytest.mark.parametrize(("text", "of_null", "of_empty", "of_values"), TABLE)
def test_null_table_row_equals_result(text: str, of_null: str, of_empty: str, of_values: str) -> None:
    rows: list[dict[str, Any]] = [{}, {field.name: [] for field in MESSAGE}, VALUES]
    expected = [json.loads(cell) for cell in (of_null, of_empty, of_values)]
    assert [value_of(text, row) for row in rows] == expected


@pytest.mark.parametrize("text", ["numbers[count]", "numbers[count:]", "numbers[:count]"])
def test_null_index_makes_result_null(text: str) -> None:
    shape = pa.struct([*MESSAGE, ("count", pa.int8())])
    scope = Scope(ExprType(shape), {})
    typed = Checker(scope, lambda *_: None, text).infer(parse(text))
    assert typed is not None
    message: Any = pa.array([{"numbers": [1.0]}, {"numbers": [1.0, 2.0], "count": 0}], shape)
    column = Evaluation(message, Envelope("", "", np.zeros(2, np.int64))).evaluate(typed).close_all(2)
    assert column.is_null().to_pylist() == [True, False]
