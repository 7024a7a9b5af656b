"""This file is an expression with every name resolved and every type known, as data one can print and compare."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import DataType
from mosaico_ingest.adapters.mapping.functions.registry import Function
from mosaico_ingest.adapters.mapping.parser import ExpressionNode, LiteralValue, Node
from mosaico_ingest.adapters.mapping.types import Kind

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


class Const(ExpressionNode, frozen=True, eq=False):
    """The same value for every row."""

    value: LiteralValue
    kind: Kind
    text: str = ""


class Whole(ExpressionNode, frozen=True, eq=False):
    """The message itself."""

    kind: Kind
    text: str = "self"


class FieldOf(ExpressionNode, frozen=True, eq=False):
    """A field of a message."""

    of: Typed
    name: str
    kind: Kind
    text: str = ""


class EachOf(ExpressionNode, frozen=True, eq=False):
    """A list, opened."""

    of: Typed
    kind: Kind
    text: str = ""


class Fold(ExpressionNode, frozen=True, eq=False):
    """The innermost open list, closed for a function that takes it whole."""

    of: Typed
    kind: Kind
    text: str = ""


class ItemOf(ExpressionNode, frozen=True, eq=False):
    """One element of a list."""

    of: Typed
    index: int
    kind: Kind
    text: str = ""


class ListValue(ExpressionNode, frozen=True, eq=False):
    """Values side by side."""

    items: tuple[Typed, ...]
    kind: Kind
    text: str = ""


class Cast(ExpressionNode, frozen=True, eq=False):
    """A number in a type it may not fit."""

    of: Typed
    type: DataType
    kind: Kind
    text: str = ""


class Apply(ExpressionNode, frozen=True, eq=False):
    """A function of other values."""

    name: str
    function: Function
    arguments: tuple[Typed, ...]
    kind: Kind
    text: str = ""


class ChoiceOf(ExpressionNode, frozen=True, eq=False):
    """One of two values."""

    condition: Typed
    then: Typed
    otherwise: Typed
    kind: Kind
    text: str = ""


class Written(Struct, frozen=True):
    """An expression as written and as understood; `typed` is None where there is no message to type it by."""

    path: KeyPath
    """Where in the file."""
    text: str
    node: Node
    typed: Typed | None


Typed: TypeAlias = "Const | Whole | FieldOf | EachOf | Fold | ItemOf | ListValue | Cast | Apply | ChoiceOf"
