"""Functions of numbers, text, bytes, null and NaN."""

from __future__ import annotations

import re
from functools import partial
from string import Formatter
from typing import Any

import numpy as np
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    ExprType,
    TypeMismatch,
    arrays,
    common_type,
    format_type,
    is_number,
    null_mask,
    open_list,
    pc,
    promote,
    pt,
    true_mask,
    variable_list,
)
from mosaico_ingest.adapters.mapping.functions.lists import absent_rows
from mosaico_ingest.adapters.mapping.functions.operators import (
    comparable,
    float_result,
    integer_result,
    numbers,
    refuse_nested,
    shifted,
)
from mosaico_ingest.adapters.mapping.functions.registry import (
    ANY,
    FLOAT,
    INTEGER,
    NUMBER,
    TEXT,
    TEXT_LITERAL,
    Parameter,
    RejectRows,
    bad_where,
    function,
    list_of,
    set_null,
)


def _joined(*expr_types: ExprType) -> ExprType:
    return common_type(list(expr_types))


def _extreme(*expr_types: ExprType) -> ExprType:
    joined = common_type(list(expr_types))
    return ExprType(arrays.int64(), bounds=joined.bounds) if joined.bounds is not None else joined


def _element_type(expr_type: ExprType, *_: ExprType) -> ExprType:
    return expr_type.element


def _null_if(expr_type: ExprType, value: ExprType) -> ExprType:
    common_type([expr_type, value])
    refuse_nested(expr_type)
    return expr_type.element


@function(ANY, returns=arrays.bool_(), sees_null=True)
def is_null(x: Array) -> Array:
    """Whether x is null; the result is never null."""
    return pc.is_null(x)


@function(ANY, returns=_joined, variadic=True, sees_null=True)
def coalesce(a: Array, *others: Array) -> Array:
    """The first argument that is not null."""
    return pc.coalesce(*promote(a, *others))


@function(ANY, ANY, returns=_null_if)
def null_if(x: Array, value: Array) -> Array:
    """Null if x equals value, else x."""
    same = arrays.array(true_mask(pc.equal(*comparable(x, value))))
    return pc.if_else(same, arrays.scalar(None, x.type), x)


@function(NUMBER, returns=_element_type)
def nan_to_null(x: Array) -> Array:
    """Null if x is NaN, else x."""
    return pc.if_else(pc.is_nan(x), arrays.scalar(None, x.type), x) if pt.is_floating(x.type) else x


def _empty_type(expr_type: ExprType) -> ExprType:
    if not (
        pt.is_string(expr_type.arrow)
        or pt.is_binary(expr_type.arrow)
        or pt.is_list(expr_type.arrow)
        or pt.is_null(expr_type.arrow)
    ):
        raise TypeMismatch("only text, bytes and lists can be empty", argument=0)
    return expr_type.element


@function(ANY, returns=_empty_type)
def empty_to_null(x: Array) -> Array:
    """Null if the text, bytes or list is empty, else x."""
    length = pc.list_value_length(x) if pt.is_list(x.type) else pc.binary_length(x)
    empty = true_mask(pc.equal(length, 0), null=True)
    if not empty.any():
        return x
    if pt.is_list(x.type):
        elements, axis = open_list(x)
        return variable_list(elements, axis.offsets, empty)
    return pc.if_else(arrays.array(empty), arrays.scalar(None, x.type), x)


@function(FLOAT, returns=arrays.bool_())
def is_nan(x: Array) -> Array:
    """Whether x is NaN (not a number)."""
    return pc.is_nan(x)


@function(FLOAT, returns=arrays.bool_())
def is_finite(x: Array) -> Array:
    """Whether x is neither infinite nor NaN."""
    return pc.is_finite(x)


def _magnitude(expr_type: ExprType) -> ExprType:
    if expr_type.bounds is None:
        return float_result(expr_type)
    low, high = expr_type.bounds
    return integer_result(0 if low <= 0 <= high else min(abs(low), abs(high)), max(abs(low), abs(high)))


@function(NUMBER, returns=_magnitude, name="abs")
def abs_(refuse: RejectRows, x: Array) -> Array:
    """Absolute value."""
    (x,) = numbers(refuse, x)
    if not pt.is_integer(x.type):
        return pc.abs(x)
    lowest = true_mask(pc.equal(x, -(2**63)))
    if lowest.any():
        refuse(lowest, "overflow", lambda _: "abs(-2 ** 63) has more than 64 bits")
    return pc.abs(x)


def _sign_type(expr_type: ExprType) -> ExprType:
    return integer_result(-1, 1) if expr_type.bounds is not None else float_result(expr_type)


@function(NUMBER, returns=_sign_type)
def sign(x: Array) -> Array:
    """Sign: -1, 0 or 1."""
    signs = pc.sign(x)
    return pc.cast(signs, arrays.int64()) if pt.is_integer(signs.type) else signs


def _add_float(name: str, run: Any, summary: str) -> None:  # noqa: ANN401 - a pyarrow function
    def apply(x: Array) -> Array:
        return run(x)

    apply.__doc__ = summary
    function(FLOAT, returns=float_result, name=name)(apply)


for _name, _run, _summary in (
    ("sqrt", pc.sqrt, "Square root; NaN below 0."),
    ("exp", pc.exp, "e to the power x."),
    ("log", pc.ln, "Natural logarithm; NaN below 0."),
    ("log10", pc.log10, "Decimal logarithm; NaN below 0."),
    ("sin", pc.sin, "Sine of x rad."),
    ("cos", pc.cos, "Cosine of x rad."),
    ("tan", pc.tan, "Tangent of x rad."),
    ("asin", pc.asin, "Arc sine in rad; NaN outside -1 … 1."),
    ("acos", pc.acos, "Arc cosine in rad; NaN outside -1 … 1."),
    ("atan", pc.atan, "Arc tangent in rad."),
    ("degrees", partial(pc.multiply, 180 / np.pi), "Radians as degrees."),
    ("radians", partial(pc.multiply, np.pi / 180), "Degrees as radians."),
    ("floor", pc.floor, "The whole number below; still a float."),
    ("ceil", pc.ceil, "The whole number above; still a float."),
    ("trunc", pc.trunc, "x without its fraction; still a float."),
    (
        "round",
        partial(pc.round, round_mode="half_to_even"),
        "The nearest whole number, half to even; still a float.",
    ),
):
    _add_float(_name, _run, _summary)


@function(FLOAT, FLOAT, returns=float_result)
def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y) in rad."""
    return pc.atan2(y, x)


@function(FLOAT, FLOAT, returns=float_result)
def hypot(x: Array, y: Array) -> Array:
    """Length of the vector (x, y)."""
    return pc.sqrt(pc.add(pc.multiply(x, x), pc.multiply(y, y)))


@function(NUMBER, NUMBER, returns=_extreme, name="min", variadic=True)
def min_(refuse: RejectRows, a: Array, b: Array, *others: Array) -> Array:
    """Smallest argument; NaN is ignored unless all arguments are NaN."""
    return pc.min_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, returns=_extreme, name="max", variadic=True)
def max_(refuse: RejectRows, a: Array, b: Array, *others: Array) -> Array:
    """Largest argument; NaN is ignored unless all arguments are NaN."""
    return pc.max_element_wise(*numbers(refuse, a, b, *others), skip_nulls=False)


@function(NUMBER, NUMBER, NUMBER, returns=_extreme)
def clip(refuse: RejectRows, x: Array, low: Array, high: Array) -> Array:
    """X limited to the range from low to high; NaN stays NaN."""
    x, low, high = numbers(refuse, x, low, high)
    clipped = pc.min_element_wise(pc.max_element_wise(x, low, skip_nulls=False), high, skip_nulls=False)
    return pc.if_else(pc.is_nan(x), x, clipped) if pt.is_floating(x.type) else clipped


@function(INTEGER, INTEGER, returns=arrays.bool_())
def bit(refuse: RejectRows, x: Array, n: Array) -> Array:
    """Whether bit n of an integer is set; the lowest is bit 0; rejects rows with n outside of 0 … 63."""
    return pc.equal(pc.bit_wise_and(shifted(refuse, ">>", x, n), 1), 1)


def _is_text_or_number(expr_type: ExprType) -> bool:
    return is_number(expr_type.arrow) or pt.is_boolean(expr_type.arrow) or pt.is_string(expr_type.arrow)


_UINT8_LIST = list_of("bytes or a list of uint8", pt.is_uint8)
_BYTES = Parameter(
    _UINT8_LIST.description, lambda expr_type: pt.is_binary(expr_type.arrow) or _UINT8_LIST.accepts(expr_type)
)
_TEXT_OR_NUMBER = Parameter("a number, text, true or false", _is_text_or_number)
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|nan)\s*")


@function(TEXT, returns=arrays.string())
def lower(s: Array) -> Array:
    """S in lower case."""
    return pc.utf8_lower(s)


@function(TEXT, returns=arrays.string())
def upper(s: Array) -> Array:
    """S in upper case."""
    return pc.utf8_upper(s)


@function(TEXT, returns=arrays.string())
def strip(s: Array) -> Array:
    """S without white space at its start and end."""
    return pc.utf8_trim_whitespace(s)


def _empty_problem(text: str) -> str | None:
    return None if text else "it is empty"


_NON_EMPTY = replace(TEXT_LITERAL, description="a text in quotes, not empty,", check_literal=_empty_problem)


@function(TEXT, _NON_EMPTY, TEXT_LITERAL, returns=arrays.string())
def replace_(s: Array, old: str, new: str) -> Array:
    """S with every occurrence of old replaced by new."""
    return pc.replace_substring(s, pattern=old, replacement=new)


@function(TEXT, TEXT_LITERAL, returns=arrays.bool_())
def starts_with(s: Array, start: str) -> Array:
    """Whether s starts with a text."""
    return pc.starts_with(s, pattern=start)


@function(TEXT, TEXT_LITERAL, returns=arrays.bool_())
def ends_with(s: Array, end: str) -> Array:
    """Whether s ends with a text."""
    return pc.ends_with(s, pattern=end)


@function(TEXT, TEXT_LITERAL, returns=arrays.bool_())
def contains(s: Array, part: str) -> Array:
    """Whether s contains a text."""
    return pc.match_substring(s, pattern=part)


@function(TEXT, _NON_EMPTY, returns=arrays.list_(arrays.string()))
def split(s: Array, separator: str) -> Array:
    """List of the parts of s between separators."""
    return pc.split_pattern(s, pattern=separator)


def _grouped(pattern: str) -> str:
    """Return a pattern with its first group, or else all of it, as a named group: Arrow returns named groups only."""
    renamed_pattern, count = re.subn(r"(?<!\\)\((?!\?)", "(?P<part>", pattern, count=1)
    return renamed_pattern if count else f"(?P<part>{pattern})"


def _pattern_problem(pattern: str) -> str | None:
    try:
        pc.extract_regex(arrays.array([], arrays.string()), pattern=_grouped(pattern))
    except arrays.ArrowInvalid:
        return f"{pattern!r} is not a regular expression of RE2"
    return None


_PATTERN = replace(TEXT_LITERAL, description="a pattern in quotes", check_literal=_pattern_problem)


@function(TEXT, _PATTERN, returns=arrays.string())
def extract(s: Array, pattern: str) -> Array:
    """The match of the pattern's first group, or of the pattern if it has no group; null without a match."""
    return pc.struct_field(pc.extract_regex(s, pattern=_grouped(pattern)), [0])


def _regex_problem(pattern: str) -> str | None:
    try:
        pc.match_substring_regex(arrays.array([], arrays.string()), pattern=pattern)
    except arrays.ArrowInvalid:
        return f"{pattern!r} is not a regular expression of RE2"
    return None


_REGEX = replace(TEXT_LITERAL, description="a pattern in quotes", check_literal=_regex_problem)


def _replacement_problem(_: Any, pattern: Any, new: Any) -> str | None:  # noqa: ANN401 - typed expressions
    try:
        pc.replace_substring_regex(arrays.array([""]), pattern=pattern.value, replacement=new.value)
    except arrays.ArrowInvalid as error:
        return str(error).partition(": ")[2]
    return None


@function(TEXT, _REGEX, TEXT_LITERAL, returns=arrays.string(), check_literals=_replacement_problem)
def regex_replace(s: Array, pattern: str, new: str) -> Array:
    r"""S with every match of a pattern replaced by new, in which `\\1` is the first group."""
    return pc.replace_substring_regex(s, pattern=pattern, replacement=new)


_SPECIFICATION = re.compile(r"(0?\d*)(\.\d+)?([defgxX]?)")


def _format_problem(template: Any, *values: Any) -> str | None:  # noqa: ANN401 - typed expressions
    try:
        parts = [part for part in Formatter().parse(template.value) if part[1] is not None]
    except ValueError as error:
        return str(error)
    if len(parts) != len(values):
        return f"the text has {len(parts)} fields, and there are {len(values)} values"
    for (_, name, specification, conversion), value in zip(parts, values, strict=True):
        match = _SPECIFICATION.fullmatch(specification or "")
        if name or conversion or match is None:
            return "a field is {}, or has a format such as {:.2f}, {:04d} or {:x}"
        if specification and not is_number(value.type.arrow):
            return f"{{:{specification}}} formats numbers, not {format_type(value.type.element)}"
        whole = match[3] in {"d", "x", "X"} or (not match[2] and not match[3])
        if specification and whole and not pt.is_integer(value.type.arrow):
            return f"{{:{specification}}} formats integers, not {format_type(value.type.element)}"
    return None


@function(
    TEXT_LITERAL,
    _TEXT_OR_NUMBER,
    returns=arrays.string(),
    variadic=True,
    check_literals=_format_problem,
    name="format",
)
def format_(template: str, x: Array, *others: Array) -> Array:
    """Text with `{}` replaced by the values, as in `format('{}: {:.2f} V', name, volts)`; formats as in Python."""
    values = iter((x, *others))
    pieces: list[Any] = []  # texts and arrays
    for literal, name, specification, _ in Formatter().parse(template):
        pieces.append(literal)
        if name is not None:
            pieces.append(_formatted(next(values), specification or ""))
    return pc.binary_join_element_wise(*pieces, "")


def _formatted(values: Array, specification: str) -> Array:
    if not specification:
        return pc.cast(values, arrays.string())
    code = (
        specification
        if specification[-1].isalpha()
        else f"{specification}{'d' if pt.is_integer(values.type) else 'f'}"
    )
    filled = np.asarray(pc.fill_null(values, 0))
    texts = np.char.mod(f"%{code}", filled) if len(filled) else np.zeros(0, str)
    return arrays.array(texts, arrays.string(), mask=null_mask(values))


@function(_TEXT_OR_NUMBER, returns=arrays.string())
def text(x: Array) -> Array:
    """A number or boolean as text."""
    return pc.cast(x, arrays.string())


@function(TEXT, returns=arrays.float64())
def number(refuse: RejectRows, s: Array) -> Array:
    """A text as a number; rejects rows with any other text."""
    try:
        return pc.cast(pc.utf8_trim_whitespace(s), arrays.float64())
    except arrays.ArrowInvalid:
        bad = bad_where(s, lambda value: _NUMBER.fullmatch(value) is not None)
        refuse(bad, "number-syntax", lambda i: f"{s[i].as_py()!r} is not a number")
        return pc.cast(pc.utf8_trim_whitespace(set_null(s, bad)), arrays.float64())


@function(_BYTES, returns=arrays.binary())
def bytes_(x: Array) -> Array:
    """A list of uint8 as bytes; null if an element is null."""
    if pt.is_binary(x.type) or pt.is_null(x.type):
        return pc.cast(x, arrays.binary())
    elements, axis = open_list(x)
    data = arrays.py_buffer(np.ascontiguousarray(np.asarray(pc.fill_null(elements, 0))))
    absent = absent_rows(elements, axis)
    validity = arrays.array(~absent).buffers()[1] if absent.any() else None
    offsets = arrays.py_buffer(axis.offsets.astype(np.int32))
    return arrays.Array.from_buffers(arrays.binary(), len(x), [validity, offsets, data])
