"""This file is an expression with every name resolved and every type known, as data one can print and compare."""

from __future__ import annotations

from dataclasses import field
from typing import TYPE_CHECKING, TypeAlias

from mosaico_ingest.adapters.mapping.columns import DataType
from mosaico_ingest.adapters.mapping.functions.registry import Function
from mosaico_ingest.adapters.mapping.parser import LiteralValue, Node
from mosaico_ingest.adapters.mapping.types import Kind
from mosaico_ingest.frozen import frozen

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath

__all__ = [
    "Apply",
    "Cast",
    "ChoiceOf",
    "Const",
    "EachOf",
    "FieldOf",
    "Fold",
    "ItemOf",
    "ListValue",
    "Typed",
    "Whole",
    "Written",
]


@frozen
class Const:
    """The same value for every row."""

    value: LiteralValue
    kind: Kind
    text: str = field(compare=False, default="")


@frozen
class Whole:
    """The message itself."""

    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="self")


@frozen
class FieldOf:
    """A field of a message."""

    of: Typed
    name: str
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class EachOf:
    """A list, opened."""

    of: Typed
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class Fold:
    """The innermost open list, closed for a function that takes it whole."""

    of: Typed
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class ItemOf:
    """One element of a list."""

    of: Typed
    index: int
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class ListValue:
    """Values side by side."""

    items: tuple[Typed, ...]
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class Cast:
    """A number in a type it may not fit."""

    of: Typed
    type: DataType
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class Apply:
    """A function of other values."""

    name: str
    function: Function = field(compare=False)
    arguments: tuple[Typed, ...]
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class ChoiceOf:
    """One of two values."""

    condition: Typed
    then: Typed
    otherwise: Typed
    kind: Kind = field(compare=False)
    text: str = field(compare=False, default="")


@frozen
class Written:
    """An expression as written and as understood; `typed` is None where there is no message to type it by."""

    path: KeyPath
    """Where in the file."""
    text: str
    node: Node
    typed: Typed | None


Typed: TypeAlias = "Const | Whole | FieldOf | EachOf | Fold | ItemOf | ListValue | Cast | Apply | ChoiceOf"
