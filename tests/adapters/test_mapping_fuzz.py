"""Random expressions and damaged files result in columns, findings or rejected rows, never in other errors."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from every_kind import every_kind

import mosaico_ingest
from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.checker import Checker, Scope
from mosaico_ingest.adapters.mapping.columns import ExprType, TypeMismatch
from mosaico_ingest.adapters.mapping.conversion import check_fits, convert
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, RowsRejected
from mosaico_ingest.adapters.mapping.expressions import ExpressionError, TypedExpression, parse
from mosaico_ingest.adapters.mapping.functions import functions
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.errors import AdapterError

STAMP = pa.struct([("sec", pa.int32()), ("nanosec", pa.uint32())])
HEADER = pa.struct([("stamp", STAMP), ("frame_id", pa.string())])
MESSAGE = every_kind(("h", HEADER), more=(("o", pa.binary()), ("q", pa.list_(pa.uint8(), 4)), ("h", HEADER)))
TARGETS: list[Any] = [
    *(pa.int8(), pa.uint64(), pa.float32(), pa.float64(), pa.string(), pa.binary(), pa.bool_()),
    *(pa.list_(t) for t in (pa.float64(), pa.int64(), pa.string(), pa.list_(pa.float32()))),
    pa.list_(pa.float64(), 3),
]
LEAVES = [
    *(field.name for field in MESSAGE),
    *(
        "self",
        "x[]",
        "y[]",
        "m[]",
        "m[].v",
        "m[].n",
        "m[].n[]",
        "m[].t",
        "m[].h.stamp",
        "p.v",
        "p.n[]",
        "h.stamp",
    ),
    *("x[0]", "m[-1].n[0]", "null", "true", "1", "-1", "0.5", "'a'", "1e300", "[1, 2]", "[]", "[i, 2.5]"),
]
OPERATORS = ["+", "-", "*", "/", "//", "%", "**", "==", "!=", "<", "<=", ">", ">=", "and", "or"]
CALLED = [f for f in functions() if f.name.isidentifier() and f.name not in {"and", "or", "not"}]
TYPES = ["bool", "int8", "uint64", "float32", "int64", "float64"]


class Writer:
    """A generator of random expressions and messages."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)  # noqa: S311 - no secret

    def program(self, depth: int) -> str:
        pick, inner = self.random, lambda: self.program(depth - 1)
        if depth == 0 or pick.random() < 0.2:
            return pick.choice(LEAVES)
        form = pick.randrange(10)
        if form < 3:
            return f"({inner()} {pick.choice(OPERATORS)} {inner()})"
        if form == 3:
            return f"({inner()} if {inner()} else {inner()})"
        if form == 4:
            return f"[{inner()}, {inner()}][{pick.choice(['', '0', '-1'])}]"
        if form == 5:
            return f"cast({inner()}, '{pick.choice(TYPES)}')"
        called = pick.choice(CALLED)
        parameters = [called.parameter(k) for k in range(len(called.parameter_types) + called.variadic)]
        texts = (
            pick.choice(["'a'", "''", "'(a)'", "'('"]) if take.literal else inner() for take in parameters
        )
        return f"{called.name}({', '.join(texts)})"

    def value(self, type_: Any) -> Any:  # noqa: PLR0911 - a return for each type
        pick = self.random
        if pick.random() < 0.08:
            return None
        if pa.types.is_struct(type_):
            return {field.name: self.value(field.type) for field in type_}
        if pa.types.is_fixed_size_list(type_) or pa.types.is_list(type_):
            fixed = pa.types.is_fixed_size_list(type_)
            return [
                self.value(type_.value_type) for _ in range(type_.list_size if fixed else pick.randrange(3))
            ]
        if pa.types.is_floating(type_):
            return pick.choice([0.0, 1.5, -2.0, float("nan"), float("inf"), 1e30])
        if pa.types.is_integer(type_):
            low, high = np.iinfo(str(type_)).min, np.iinfo(str(type_)).max
            return pick.choice([0, 1, 2, low, high])
        if pa.types.is_boolean(type_):
            return pick.random() < 0.5
        return pick.choice(["", "a", "12", "ż"]) if pa.types.is_string(type_) else pick.choice([b"", b"ab"])


def run(typed: TypedExpression, rows: Any) -> None:
    """Evaluate, and convert to a type that fits; each round excludes the rows rejected before."""
    while True:
        evaluation = Evaluation(rows, Envelope("", "", np.zeros(len(rows), np.int64)))
        try:
            result = evaluation.evaluate(typed).close_all(len(rows))
            result.validate(full=True)
            assert len(result) == len(rows)
            for target in TARGETS:
                check_fit(typed, result, target, evaluation)
        except RowsRejected as rejected:
            good = np.ones(len(rows), bool)
            good[list(rejected.rejections)] = False
            remaining = rows.filter(pa.array(good))
        else:
            return
        assert len(remaining) < len(rows)
        rows = remaining


def check_fit(typed: TypedExpression, result: Any, target: Any, evaluation: Evaluation) -> None:
    try:
        check_fits(typed.type, target)
    except TypeMismatch:
        return
    fitted = convert(result, target, evaluation.rejecter((), "it"))
    fitted.validate(full=True)
    assert (fitted.type, len(fitted)) == (target, len(result))


def attempts(seed: int, count: int) -> int:
    """Return the number of valid expressions."""
    writer = Writer(seed)
    rows: Any = pa.array([writer.value(MESSAGE) or {} for _ in range(12)], MESSAGE)
    meant = 0
    for _ in range(count):
        text = writer.program(3)
        try:
            typed = Checker(Scope(ExprType(MESSAGE), {}), lambda *_: None, text).infer(parse(text))
        except ExpressionError:
            continue
        if typed is not None:
            meant += 1
            run(typed, rows)
    return meant


def test_random_expressions_return_columns_findings_or_rejections() -> None:
    assert attempts(seed=1, count=1500) > 100


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 8))
def test_many_random_expressions_return_columns_findings_or_rejections(seed: int) -> None:
    assert attempts(seed, count=15_000) > 1000


def test_load_adapter_damaged_file_loads_or_raises_adapter_error() -> None:
    folder = Path(mosaico_ingest.__file__).parent / "adapters" / "catalog"
    texts = [path.read_text("utf-8") for path in sorted(folder.glob("*.yaml"))]
    pick = random.Random(7)  # noqa: S311 - no secret
    errors: list[AdapterError] = []
    for _ in range(400):
        text = pick.choice(texts)
        for _ in range(pick.randrange(1, 4)):
            at, length = pick.randrange(len(text)), pick.randrange(12)
            other = pick.choice(texts)
            start = pick.randrange(len(other))
            text = text[:at] + other[start : start + pick.randrange(12)] + text[at + length :]
        try:
            load_adapter(text, file="damaged.yaml")
        except AdapterError as error:
            errors.append(error)
    assert len(errors) > 100
    assert all(error.findings for error in errors)
    assert all(finding.span is not None for error in errors for finding in error.findings)
