"""The registry of the functions that expressions may call, and the decorator that adds one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from functools import partial
from typing import Any, Protocol, TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    DataType,
    ExprType,
    Mask,
    TypeMismatch,
    arrays,
    expr_type_of,
    format_type,
    is_list,
    is_number,
    pc,
    pt,
)
from mosaico_ingest.errors import AdapterError


class RejectRows(Protocol):
    """Rejects the rows of invalid elements; returns if none of them is needed, because its branch is not taken."""

    def __call__(self, bad: Mask, rule: str, reason: Callable[[int], str]) -> None:
        """Reject the rows where `bad` is true; `reason` returns the reason for the element at a position."""
        ...


class Parameter(Struct, frozen=True):
    """The arguments that a parameter accepts, and their conversion before the call."""

    description: str
    """What the parameter takes, as in "sqrt takes a number"."""
    accepts: Callable[[ExprType], bool]
    prepare: Callable[[Any], Any] | None = None
    literal: bool = False
    """The argument must be a literal in the expression; the function receives it as a Python value."""
    check_literal: Callable[[str], str | None] | None = None
    """Returns the problem of a literal text, None if it is valid."""
    hint: str | None = None
    """The remedy for an argument of another type."""
    of_elements: bool = False
    """The argument is evaluated for each element of the first argument, and names refer to that element."""

    def takes(self, expr_type: ExprType) -> bool:
        """Return whether an argument of a type is accepted; null always is."""
        return pt.is_null(expr_type.arrow) or self.accepts(expr_type)


ResultType: TypeAlias = "Callable[..., ExprType]"


class Function(Struct, frozen=True):
    """A function over columns: its arguments are arrays of one length, or scalars where `scalars` allows them."""

    name: str
    parameter_types: tuple[Parameter, ...]
    """The last one repeats if `variadic`."""
    result_type: ResultType
    """Maps the types of the arguments to the type of the result; raises `TypeMismatch`."""
    apply: Callable[..., Any]
    optional: int = 0
    """Number of trailing parameters that may be omitted."""
    variadic: bool = False
    scalars: bool = False
    """Whether `apply` accepts literals as Arrow scalars; otherwise all arguments are arrays."""
    sees_null: bool = False
    """Whether a literal null reaches `apply`; otherwise it makes the result null."""
    refuses: bool = False
    """Whether `apply` takes a `RejectRows` as its first argument."""
    named: bool = False
    """Whether `result_type` and `apply` take the names of the arguments as the keyword `names`."""
    check_literals: Callable[..., str | None] | None = None
    """Returns the problem of the typed arguments of a call together, None if they are valid."""
    parameters: tuple[str, ...] = ()
    summary: str = ""

    @property
    def signature(self) -> str:
        """The call as written in an expression, such as `clip(x, low, high)`."""
        return f"{self.name}({', '.join(self.parameters)}{', …' if self.variadic else ''})"

    def arity_problem(self, count: int) -> str | None:
        """Return the problem of a number of arguments, None if it is valid."""
        maximum = len(self.parameter_types)
        if count < maximum - self.optional or (count > maximum and not self.variadic):
            return f"{self.signature} takes {self._arity()}, not {count}"
        return None

    def parameter(self, position: int) -> Parameter:
        """Return the parameter of an argument."""
        return self.parameter_types[min(position, len(self.parameter_types) - 1)]

    def with_names(self, names: tuple[str, ...]) -> Function:
        """Return the function for arguments of these names."""
        return replace(
            self,
            result_type=partial(self.result_type, names=names),
            apply=partial(self.apply, names=names),
            named=False,
        )

    def _arity(self) -> str:
        maximum = len(self.parameter_types)
        minimum = maximum - self.optional
        if self.variadic:
            return f"{minimum} arguments or more"
        count = str(maximum) if maximum == minimum else f"{minimum} to {maximum}"
        return f"{count} argument{'' if count == '1' else 's'}"


_FUNCTIONS: dict[str, Function] = {}


def function(
    *parameters: Parameter,
    returns: ResultType | DataType,
    name: str | None = None,
    optional: int = 0,
    variadic: bool = False,
    scalars: bool = False,
    sees_null: bool = False,
    named: bool = False,
    check_literals: Callable[..., str | None] | None = None,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add a function to the language; the first line of its docstring is its documentation.

    The decorated function receives one array per argument, all of one length, and returns an array. If its first
    parameter is called `refuse`, it receives a `RejectRows`.

    Raises:
        AdapterError: Another module defines a function of the same name.
    """

    def register(apply: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(apply).parameters
        names = tuple(
            name for name, p in signature.items() if p.kind not in {p.VAR_POSITIONAL, p.KEYWORD_ONLY}
        )
        refuses = names[:1] == ("refuse",)
        function_name = name or apply.__name__.rstrip("_")
        other = _FUNCTIONS.get(function_name)
        if other is not None and other.apply.__module__ != apply.__module__:
            raise AdapterError(
                f"there is already a function {function_name!r} in {other.apply.__module__}",
                where=apply.__module__,
                hint="rename yours",
            )
        _FUNCTIONS[function_name] = Function(
            name=function_name,
            parameter_types=parameters,
            result_type=_always(returns) if isinstance(returns, arrays.DataType) else returns,
            apply=apply,
            optional=optional,
            variadic=variadic,
            scalars=scalars,
            sees_null=sees_null,
            refuses=refuses,
            named=named,
            check_literals=check_literals,
            parameters=names[refuses:],
            summary=(apply.__doc__ or "").strip().split("\n", maxsplit=1)[0],
        )
        return apply

    return register


def functions() -> tuple[Function, ...]:
    """Return all functions and operators in the order of their registration."""
    return tuple(_FUNCTIONS.values())


def lookup(name: str) -> Function | None:
    """Return the function of a name, None if there is none."""
    return _FUNCTIONS.get(name)


def check_call(called: Function, arguments: list[ExprType]) -> ExprType:
    """Return the type of a call; the arguments have no open lists. A literal null usually makes the result null.

    Raises:
        TypeMismatch: The function does not accept an argument.
    """
    for position, argument in enumerate(arguments):
        parameter = called.parameter(position)
        if not parameter.takes(argument):
            message = f"{called.name} takes {parameter.description} here, not {format_type(argument)}"
            raise TypeMismatch(message, argument=position, hint=parameter.hint)
    if not called.sees_null and any(pt.is_null(argument.arrow) for argument in arguments):
        return ExprType(arrays.null())
    return called.result_type(*arguments)


_SYNONYMS = {
    "greatest": "list_max array_max amax max_of maximum list_maximum",
    "least": "list_min array_min amin min_of minimum list_minimum",
    "sum": "list_sum array_sum total list_add",
    "mean": "list_mean list_avg avg average",
    "len": "length size count cardinality list_len list_length array_length char_length",
    "any": "list_any bool_or some",
    "all": "list_all bool_and every",
    "is_null": "isnull is_none isna missing",
    "is_nan": "isnan",
    "is_finite": "isfinite is_inf isinf",
    "coalesce": "ifnull nvl fillna fill_null default",
    "null_if": "nullif",
    "hypot": "length",
    "norm": "magnitude list_norm euclidean",
    "degrees": "deg rad2deg to_degrees",
    "radians": "rad deg2rad to_radians",
    "log": "ln",
    "ceil": "ceiling",
    "trunc": "truncate fix",
    "clip": "clamp bound",
    "text": "str string to_string to_text format",
    "number": "to_number parse_number",
    "lower": "lowercase to_lower tolower",
    "upper": "uppercase to_upper toupper",
    "strip": "trim",
    "replace": "substitute regex_replace",
    "extract": "regex regex_extract match regexp_extract",
    "contains": "includes",
    "bytes": "blob binary to_bytes",
    "seconds": "to_sec to_seconds",
    "nanoseconds": "to_nsec to_nanoseconds",
    "quaternion_from_rpy": "quaternion_from_euler euler_to_quaternion rpy_to_quaternion",
    "yaw": "heading quaternion_to_yaw",
}
_BY_SYNONYM = {synonym: name for name, synonyms in _SYNONYMS.items() for synonym in synonyms.split()}
_INSTEAD = {
    "int": "cast(x, 'int64')",
    "float": "cast(x, 'float64')",
    "bool": "x != 0",
    "pow": "x ** y",
    "power": "x ** y",
    "mod": "x % y",
    "concat": "a + b",
    "if": "a if condition else b",
    "where": "a if condition else b",
    "iif": "a if condition else b",
    "case": "a if condition else b",
    "first": "list[0]",
    "last": "list[-1]",
}
"""Functions of other languages that are operators or casts in this one."""


def suggest(word: str, words: Iterable[str]) -> str | None:
    """Return `did you mean …?` if one of the words is similar."""
    close = get_close_matches(word, list(words), n=1)
    return f"did you mean {close[0]!r}?" if close else None


def suggest_synonym(name: str) -> str | None:
    """Return the hint for the name that a function has in another language, such as `list_max` for `greatest`."""
    instead = _INSTEAD.get(name.lower())
    if instead is not None:
        return f"write {instead}"
    synonym = _FUNCTIONS.get(_BY_SYNONYM.get(name.lower(), ""))
    return f"use {synonym.signature}: {synonym.summary.rstrip('.')}" if synonym else None


def set_null(values: Any, mask: Mask) -> Any:  # noqa: ANN401 - an Arrow array or scalar
    """Return the values, with null where `mask` is true."""
    return pc.if_else(arrays.array(mask), arrays.scalar(None, values.type), values)


def bad_where(array: Array, is_valid: Callable[[Any], bool]) -> Mask:
    """Return where a check fails; it runs value by value, so call it only for batches that are known to fail."""
    return np.fromiter((v is not None and not is_valid(v) for v in array.to_pylist()), bool, len(array))


def struct_with(description: str, *choices: Mapping[str, Callable[[DataType], bool]]) -> Parameter:
    """Return a parameter for messages that have all the fields of one of the choices, of matching types."""

    def has(type_: DataType, name: str, matches: Callable[[DataType], bool]) -> bool:
        position = type_.get_field_index(name)
        return position >= 0 and matches(type_.field(position).type)

    def accepts(expr_type: ExprType) -> bool:
        return pt.is_struct(expr_type.arrow) and any(
            all(has(expr_type.arrow, name, matches) for name, matches in choice.items()) for choice in choices
        )

    return Parameter(description, accepts)


def list_of(description: str, accepts: Callable[[DataType], bool]) -> Parameter:
    """Return a parameter for lists whose element type is accepted."""
    return Parameter(
        description, lambda expr_type: is_list(expr_type.arrow) and accepts(expr_type.arrow.value_type)
    )


def _always(type_: DataType) -> ResultType:
    expr_type = expr_type_of(type_)
    return lambda *_: expr_type


def _as_float(values: Array) -> Array:
    return values if values.type == arrays.float64() else pc.cast(values, arrays.float64(), safe=False)


def _typed_null(type_: DataType) -> Callable[[Array], Array]:
    """Return a conversion that gives literal nulls a type."""

    def prepare(values: Array) -> Array:
        return pc.cast(values, type_) if pt.is_null(values.type) else values

    return prepare


FLOAT = Parameter("a number", lambda expr_type: is_number(expr_type.arrow), _as_float)
NUMBER = Parameter("a number", lambda expr_type: is_number(expr_type.arrow), _typed_null(arrays.int64()))
INTEGER = Parameter(
    "an integer", lambda expr_type: pt.is_integer(expr_type.arrow), _typed_null(arrays.int64())
)
BOOLEAN = Parameter(
    "a boolean", lambda expr_type: pt.is_boolean(expr_type.arrow), _typed_null(arrays.bool_())
)
TEXT = Parameter("text", lambda expr_type: pt.is_string(expr_type.arrow), _typed_null(arrays.string()))
BINARY = Parameter("bytes", lambda expr_type: pt.is_binary(expr_type.arrow), _typed_null(arrays.binary()))
LIST = Parameter("a list", lambda expr_type: is_list(expr_type.arrow))
STRUCT = Parameter("a message", lambda expr_type: pt.is_struct(expr_type.arrow))
ANY = Parameter("a value", lambda _: True)
TEXT_LITERAL = Parameter("a text in quotes", lambda expr_type: pt.is_string(expr_type.arrow), literal=True)
