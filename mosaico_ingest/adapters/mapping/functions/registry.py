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
    Kind,
    Unfit,
    is_list,
    is_number,
    kind_of,
    spell,
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
    "Gives",
    "Refuse",
    "Take",
    "function",
    "functions",
    "lookup",
    "nearest",
    "nullified",
]


class Refuse(Protocol):
    """Rejects the rows of bad elements; returns only if none of them counts (its branch was not taken)."""

    def __call__(self, bad: Mask, rule: str, says: Callable[[int], str]) -> None:
        """`bad` is true where an element does not fit, `says` tells why of the element at a position."""
        ...


class Take(Struct, frozen=True):
    """What a parameter accepts, and how the argument is made ready for it."""

    words: str
    accepts: Callable[[Kind], bool]
    prepare: Callable[[Any], Any] | None = None
    literal: bool = False
    """The argument is written out in the expression, and handed over as a Python value."""
    problem: Callable[[str], str | None] | None = None
    """What is wrong with a text that is written out."""

    def takes(self, kind: Kind) -> bool:
        """Return whether an argument of a kind is accepted; null always is."""
        return pt.is_null(kind.type) or self.accepts(kind)


Gives: TypeAlias = "Callable[..., Kind]"


class Function(Struct, frozen=True):
    """A function over whole columns: arguments are arrays of one length, or scalars where literal."""

    name: str
    takes: tuple[Take, ...]
    """The last one repeats where `variadic`."""
    gives: Gives
    """From the kinds of the arguments to the kind of the result; raises `Unfit`."""
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
        most = len(self.takes)
        if given < most - self.optional or (given > most and not self.variadic):
            return f"{self.signature} takes {self._count()}, not {given}"
        return None

    def take(self, position: int) -> Take:
        """Return the parameter an argument goes to."""
        return self.takes[min(position, len(self.takes) - 1)]

    def _count(self) -> str:
        most, least = len(self.takes), len(self.takes) - self.optional
        if self.variadic:
            return f"{least} arguments or more"
        words = str(most) if most == least else f"{least} to {most}"
        return f"{words} argument{'' if words == '1' else 's'}"


_FUNCTIONS: dict[str, Function] = {}


def function(
    *takes: Take,
    gives: Gives | DataType,
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
            takes=takes,
            gives=_constant(gives) if isinstance(gives, arrays.DataType) else gives,
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


def nearest(word: str, words: list[str]) -> str | None:
    """Return `did you mean …?` where one of the words is near."""
    close = get_close_matches(word, words, n=1)
    return f"did you mean {close[0]!r}?" if close else None


def nullified(values: Any, bad: Mask) -> Any:  # noqa: ANN401 - an Arrow array or scalar
    """Return the values with those at `bad` null."""
    return pc.if_else(arrays.array(bad), arrays.scalar(None, values.type), values)


def _constant(type_: DataType) -> Gives:
    kind = kind_of(type_)

    def gives(*_: Kind) -> Kind:
        return kind

    return gives


def _as_float(values: Array) -> Array:
    return values if values.type == arrays.float64() else pc.cast(values, arrays.float64(), safe=False)


def _typed(type_: DataType) -> Callable[[Array], Array]:
    def prepare(values: Array) -> Array:
        return pc.cast(values, type_) if pt.is_null(values.type) else values

    return prepare


FLOAT = Take("a number", lambda kind: is_number(kind.type), _as_float)
NUMBER = Take("a number", lambda kind: is_number(kind.type), _typed(arrays.int64()))
INTEGER = Take("an integer", lambda kind: pt.is_integer(kind.type), _typed(arrays.int64()))
BOOLEAN = Take("true or false", lambda kind: pt.is_boolean(kind.type), _typed(arrays.bool_()))
TEXT = Take("text", lambda kind: pt.is_string(kind.type), _typed(arrays.string()))
BINARY = Take("bytes", lambda kind: pt.is_binary(kind.type), _typed(arrays.binary()))
LIST = Take("a list", lambda kind: is_list(kind.type))
STRUCT = Take("a message", lambda kind: pt.is_struct(kind.type))
ANY = Take("a value", lambda _: True)
TEXT_LITERAL = Take("a text in quotes", lambda kind: pt.is_string(kind.type), literal=True)


def struct_with(words: str, *choices: Mapping[str, Callable[[DataType], bool]]) -> Take:
    """Return a parameter for messages that have all the fields of one of the choices, of the right types."""

    def has(type_: DataType, name: str, fits: Callable[[DataType], bool]) -> bool:
        position = type_.get_field_index(name)
        return position >= 0 and fits(type_.field(position).type)

    def accepts(kind: Kind) -> bool:
        return pt.is_struct(kind.type) and any(
            all(has(kind.type, name, fits) for name, fits in choice.items()) for choice in choices
        )

    return Take(words, accepts)


def list_of(words: str, accepts: Callable[[DataType], bool]) -> Take:
    """Return a parameter for lists whose elements are accepted."""
    return Take(words, lambda kind: is_list(kind.type) and accepts(kind.type.value_type))


def check(called: Function, kinds: list[Kind]) -> Kind:
    """Return the kind a call gives, for arguments without open lists; null where one is and that decides it.

    Raises:
        Unfit: An argument is none that the function takes.
    """
    for position, kind in enumerate(kinds):
        take = called.take(position)
        if not take.takes(kind):
            raise Unfit(f"{called.name} takes {take.words} here, not {spell(kind)}", argument=position)
    if not called.sees_null and any(pt.is_null(kind.type) for kind in kinds):
        return Kind(arrays.null())
    return called.gives(*kinds)


def bad_where(array: Array, fits: Callable[[Any], bool]) -> Mask:
    """Return where a check fails, one by one; for batches that are known to have failed."""
    return np.fromiter((v is not None and not fits(v) for v in array.to_pylist()), bool, len(array))
