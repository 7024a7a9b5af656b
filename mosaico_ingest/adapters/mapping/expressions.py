"""This file is an expression with every name resolved and every type known, as data one can print and compare."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import DataType
from mosaico_ingest.adapters.mapping.functions.registry import Function
from mosaico_ingest.adapters.mapping.parser import ExpressionNode, LiteralValue, Node
from mosaico_ingest.adapters.mapping.types import ExprType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath

__all__ = [
    "AnalyzedExpression",
    "Cast",
    "CloseList",
    "Conditional",
    "Constant",
    "ElementAt",
    "FieldAccess",
    "FunctionCall",
    "MakeList",
    "MessageRef",
    "OpenList",
    "TypedExpression",
]


class Constant(ExpressionNode, frozen=True, eq=False):
    """The same value for every row."""

    value: LiteralValue
    type: ExprType
    text: str = ""


class MessageRef(ExpressionNode, frozen=True, eq=False):
    """The message itself."""

    type: ExprType
    text: str = "self"


class FieldAccess(ExpressionNode, frozen=True, eq=False):
    """A field of a message."""

    operand: TypedExpression
    name: str
    type: ExprType
    text: str = ""


class OpenList(ExpressionNode, frozen=True, eq=False):
    """A list, opened."""

    operand: TypedExpression
    type: ExprType
    text: str = ""


class CloseList(ExpressionNode, frozen=True, eq=False):
    """The innermost open list, closed for a function that takes it whole."""

    operand: TypedExpression
    type: ExprType
    text: str = ""


class ElementAt(ExpressionNode, frozen=True, eq=False):
    """One element of a list."""

    operand: TypedExpression
    index: int
    type: ExprType
    text: str = ""


class MakeList(ExpressionNode, frozen=True, eq=False):
    """Values side by side."""

    items: tuple[TypedExpression, ...]
    type: ExprType
    text: str = ""


class Cast(ExpressionNode, frozen=True, eq=False):
    """A number in a type it may not fit."""

    operand: TypedExpression
    target: DataType
    type: ExprType
    text: str = ""


class FunctionCall(ExpressionNode, frozen=True, eq=False):
    """A function of other values."""

    name: str
    function: Function
    arguments: tuple[TypedExpression, ...]
    type: ExprType
    text: str = ""


class Conditional(ExpressionNode, frozen=True, eq=False):
    """One of two values."""

    condition: TypedExpression
    then: TypedExpression
    otherwise: TypedExpression
    type: ExprType
    text: str = ""


class AnalyzedExpression(Struct, frozen=True):
    """An expression as written and as understood; `typed` is None where there is no message to type it by."""

    path: KeyPath
    """Where in the file."""
    text: str
    node: Node
    typed: TypedExpression | None


TypedExpression: TypeAlias = "Constant | MessageRef | FieldAccess | OpenList | CloseList | ElementAt | MakeList | Cast | FunctionCall | Conditional"
