"""Typed expressions: every name is resolved and every type known, before any row is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import DataType
from mosaico_ingest.adapters.mapping.functions.registry import Function
from mosaico_ingest.adapters.mapping.parser import ExpressionNode, LiteralValue, Node
from mosaico_ingest.adapters.mapping.types import ExprType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath


class Constant(ExpressionNode, frozen=True, eq=False):
    """A value that is the same for every row."""

    value: LiteralValue
    type: ExprType
    text: str = ""

    def _content(self) -> tuple[object, ...]:
        return (repr(self.value), self.type.arrow)  # because True == 1 == 1.0, and 0.0 == -0.0


class MessageRef(ExpressionNode, frozen=True, eq=False):
    """The message in which names are looked up."""

    type: ExprType
    text: str = "self"


class EnvelopeField(ExpressionNode, frozen=True, eq=False):
    """A property of the message besides its content, such as `message.log_time`."""

    name: str
    type: ExprType
    text: str = ""


class OuterValue(ExpressionNode, frozen=True, eq=False):
    """A value of an enclosing scope, repeated for the nested messages of each of its rows."""

    operand: TypedExpression
    levels: int
    """The number of scopes between the expression and the operand."""
    type: ExprType
    text: str = ""


class FieldAccess(ExpressionNode, frozen=True, eq=False):
    """A field of a message."""

    operand: TypedExpression
    name: str
    type: ExprType
    text: str = ""


class OpenList(ExpressionNode, frozen=True, eq=False):
    """The elements of a list (`operand[]`): operations on them apply to each element."""

    operand: TypedExpression
    type: ExprType
    text: str = ""


class CloseList(ExpressionNode, frozen=True, eq=False):
    """A list rebuilt from its elements, because a function takes the list instead of one element."""

    operand: TypedExpression
    type: ExprType
    text: str = ""


class ElementAt(ExpressionNode, frozen=True, eq=False):
    """One element of a list, null if the list is too short."""

    operand: TypedExpression
    index: int
    type: ExprType
    text: str = ""


class MakeList(ExpressionNode, frozen=True, eq=False):
    """A fixed-size list of values."""

    items: tuple[TypedExpression, ...]
    type: ExprType
    text: str = ""


class Cast(ExpressionNode, frozen=True, eq=False):
    """A number in another type, checked for every row."""

    operand: TypedExpression
    target: DataType
    type: ExprType
    text: str = ""


class FunctionCall(ExpressionNode, frozen=True, eq=False):
    """A function or operator applied to its arguments."""

    name: str
    function: Function
    arguments: tuple[TypedExpression, ...]
    type: ExprType
    text: str = ""
    names: tuple[str, ...] = ()
    """The names of the arguments, for a function whose result depends on them."""


class Conditional(ExpressionNode, frozen=True, eq=False):
    """One of two values, chosen for each row."""

    condition: TypedExpression
    then: TypedExpression
    otherwise: TypedExpression
    type: ExprType
    text: str = ""


class AnalyzedExpression(Struct, frozen=True):
    """An expression of the file; `typed` is None while no message definition is known."""

    path: KeyPath
    """The key path of the expression in the file."""
    text: str
    node: Node
    typed: TypedExpression | None


TypedExpression: TypeAlias = "Constant | MessageRef | EnvelopeField | OuterValue | FieldAccess | OpenList | CloseList | ElementAt | MakeList | Cast | FunctionCall | Conditional"
