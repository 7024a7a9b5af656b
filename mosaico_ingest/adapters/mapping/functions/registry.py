"""This file is the list of functions an expression may call, and the decorator that adds one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any, Protocol, TypeAlias

import numpy as np
from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import (
    Array,
    DataType,
    Mask,
    arrays,
    pc,
    pt,
)
from mosaico_ingest.adapters.mapping.types import (
    ExprType,
    TypeMismatch,
    expr_type_of,
    format_type,
    is_list,
    is_number,
)
from mosaico_ingest.errors import AdapterError

__all__ = [
    "ANY",
    "BINARY",
    "BOOLEAN",
    "FLOAT",
    "INTEGER",
    "LIST",
    "NUMBER",
    "STRUCT",
    "TEXT",
    "TEXT_LITERAL",
    "Function",
    "Parameter",
    "RejectRows",
    "ResultType",
    "function",
    "functions",
    "lookup",
    "set_null",
    "suggest",
]


class RejectRows(Protocol):
    """Rejects the rows of bad elements; returns only if none of them counts (its branch was not taken)."""

    def __call__(self, bad: Mask, rule: str, says: Callable[[int], str]) -> None:
        """`bad` is true where an element does not fit, `says` tells why of the element at a position."""
        ...


class Parameter(Struct, frozen=True):
    """What a parameter accepts, and how the argument is made ready for it."""

    description: str
    accepts: Callable[[ExprType], bool]
    prepare: Callable[[Any], Any] | None = None
    literal: bool = False
    """The argument is written out in the expression, and handed over as a Python value."""
    check_literal: Callable[[str], str | None] | None = None
    """What is wrong with a text that is written out."""

    def takes(self, expr_type: ExprType) -> bool:
        """Return whether an argument of a expr_type is accepted; null always is."""
        return pt.is_null(expr_type.arrow) or self.accepts(expr_type)


ResultType: TypeAlias = "Callable[..., ExprType]"


class Function(Struct, frozen=True):
    """A function over whole columns: arguments are arrays of one length, or scalars where literal."""

    name: str
    parameter_types: tuple[Parameter, ...]
    """The last one repeats where `variadic`."""
    result_type: ResultType
    """From the expr_types of the arguments to the expr_type of the result; raises `Unfit`."""
    apply: Callable[..., Any]
    optional: int = 0
    """How many of the last parameters may be left out."""
    variadic: bool = False
    scalars: bool = False
    """Whether literals may come as Arrow scalars; otherwise all arguments are arrays."""
    sees_null: bool = False
    """Whether it can give something for null; otherwise a null argument makes the result null."""
    refuses: bool = False
    """Whether `apply` takes a `Refuse` first."""
    parameters: tuple[str, ...] = ()
    summary: str = ""

    @property
    def signature(self) -> str:
        """As `clip(x, low, high)`."""
        return f"{self.name}({', '.join(self.parameters)}{', …' if self.variadic else ''})"

    def arity_problem(self, given: int) -> str | None:
        """Return what is wrong with a number of arguments."""
        most = len(self.parameter_types)
        if given < most - self.optional or (given > most and not self.variadic):
            return f"{self.signature} takes {self._count()}, not {given}"
        return None

    def parameter(self, position: int) -> Parameter:
        """Return the parameter an argument goes to."""
        return self.parameter_types[min(position, len(self.parameter_types) - 1)]

    def _count(self) -> str:
        most, least = len(self.parameter_types), len(self.parameter_types) - self.optional
        if self.variadic:
            return f"{least} arguments or more"
        words = str(most) if most == least else f"{least} to {most}"
        return f"{words} argument{'' if words == '1' else 's'}"


_FUNCTIONS: dict[str, Function] = {}


def function(
    *takes: Parameter,
    returns: ResultType | DataType,
    name: str | None = None,
    optional: int = 0,
    variadic: bool = False,
    scalars: bool = False,
    sees_null: bool = False,
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add a function to the language; its docstring's first line is its documentation.

    The decorated function gets one array for each argument, all of one length, and returns an array. A first parameter called `refuse` rejects rows, see `Refuse`.

    Raises:
        AdapterError: Another module has a function of that name.
    """

    def add(apply: Callable[..., Any]) -> Callable[..., Any]:
        known = inspect.signature(apply).parameters
        parameters = tuple(name for name, p in known.items() if p.kind is not p.VAR_POSITIONAL)
        refuses = parameters[:1] == ("refuse",)
        spelled = name or apply.__name__.rstrip("_")
        taken = _FUNCTIONS.get(spelled)
        if taken is not None and taken.apply.__module__ != apply.__module__:
            hint = f"{taken.apply.__module__} has it; give yours another name"
            raise AdapterError(f"there is already a function {spelled!r}", where=apply.__module__, hint=hint)
        _FUNCTIONS[spelled] = Function(
            name=spelled,
            parameter_types=takes,
            result_type=_constant(returns) if isinstance(returns, arrays.DataType) else returns,
            apply=apply,
            optional=optional,
            variadic=variadic,
            scalars=scalars,
            sees_null=sees_null,
            refuses=refuses,
            parameters=parameters[refuses:],
            summary=(apply.__doc__ or "").strip().split("\n", maxsplit=1)[0],
        )
        return apply

    return add


def functions() -> tuple[Function, ...]:
    """Return all functions and operators, in the order they were added."""
    return tuple(_FUNCTIONS.values())


def lookup(name: str) -> Function | None:
    """Return a function by its name."""
    return _FUNCTIONS.get(name)


def suggest(word: str, words: list[str]) -> str | None:
    """Return `did you mean …?` where one of the words is near."""
    close = get_close_matches(word, words, n=1)
    return f"did you mean {close[0]!r}?" if close else None


def set_null(values: Any, bad: Mask) -> Any:  # noqa: ANN401 - an Arrow array or scalar
    """Return the values with those at `bad` null."""
    return pc.if_else(arrays.array(bad), arrays.scalar(None, values.type), values)


def _constant(type_: DataType) -> ResultType:
    expr_type = expr_type_of(type_)

    def gives(*_: ExprType) -> ExprType:
        return expr_type

    return gives


def _as_float(values: Array) -> Array:
    return values if values.type == arrays.float64() else pc.cast(values, arrays.float64(), safe=False)


def _typed(type_: DataType) -> Callable[[Array], Array]:
    def prepare(values: Array) -> Array:
        return pc.cast(values, type_) if pt.is_null(values.type) else values

    return prepare


FLOAT = Parameter("a number", lambda expr_type: is_number(expr_type.arrow), _as_float)
NUMBER = Parameter("a number", lambda expr_type: is_number(expr_type.arrow), _typed(arrays.int64()))
INTEGER = Parameter("an integer", lambda expr_type: pt.is_integer(expr_type.arrow), _typed(arrays.int64()))
BOOLEAN = Parameter("true or false", lambda expr_type: pt.is_boolean(expr_type.arrow), _typed(arrays.bool_()))
TEXT = Parameter("text", lambda expr_type: pt.is_string(expr_type.arrow), _typed(arrays.string()))
BINARY = Parameter("bytes", lambda expr_type: pt.is_binary(expr_type.arrow), _typed(arrays.binary()))
LIST = Parameter("a list", lambda expr_type: is_list(expr_type.arrow))
STRUCT = Parameter("a message", lambda expr_type: pt.is_struct(expr_type.arrow))
ANY = Parameter("a value", lambda _: True)
TEXT_LITERAL = Parameter("a text in quotes", lambda expr_type: pt.is_string(expr_type.arrow), literal=True)


def struct_with(words: str, *choices: Mapping[str, Callable[[DataType], bool]]) -> Parameter:
    """Return a parameter for messages that have all the fields of one of the choices, of the right types."""

    def has(type_: DataType, name: str, fits: Callable[[DataType], bool]) -> bool:
        position = type_.get_field_index(name)
        return position >= 0 and fits(type_.field(position).type)

    def accepts(expr_type: ExprType) -> bool:
        return pt.is_struct(expr_type.arrow) and any(
            all(has(expr_type.arrow, name, fits) for name, fits in choice.items()) for choice in choices
        )

    return Parameter(words, accepts)


def list_of(words: str, accepts: Callable[[DataType], bool]) -> Parameter:
    """Return a parameter for lists whose elements are accepted."""
    return Parameter(
        words, lambda expr_type: is_list(expr_type.arrow) and accepts(expr_type.arrow.value_type)
    )


def check_call(called: Function, expr_types: list[ExprType]) -> ExprType:
    """Return the expr_type a call gives, for arguments without open lists; null where one is and that decides it.

    Raises:
        Unfit: An argument is none that the function takes.
    """
    for position, expr_type in enumerate(expr_types):
        take = called.parameter(position)
        if not take.takes(expr_type):
            raise TypeMismatch(
                f"{called.name} takes {take.description} here, not {format_type(expr_type)}",
                argument=position,
            )
    if not called.sees_null and any(pt.is_null(expr_type.arrow) for expr_type in expr_types):
        return ExprType(arrays.null())
    return called.result_type(*expr_types)


def bad_where(array: Array, fits: Callable[[Any], bool]) -> Mask:
    """Return where a check fails, one by one; for batches that are known to have failed."""
    return np.fromiter((v is not None and not fits(v) for v in array.to_pylist()), bool, len(array))
