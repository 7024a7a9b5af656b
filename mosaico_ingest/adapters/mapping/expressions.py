"""Expressions: their syntax tree, the parser of their text, and typed expressions.

Python's own parser reads the text, so the syntax is Python's with one addition: `a[]` stands for every element of `a`.
The result is translated to the node classes below; nothing is ever executed as Python.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias, cast

from msgspec import Struct

from mosaico_ingest.adapters.mapping.columns import DataType, ExprType
from mosaico_ingest.adapters.mapping.functions.registry import Function

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath
MAX_CHARACTERS = 4000
MAX_DEPTH = 60
LiteralValue: TypeAlias = "bool | int | float | str | None"
TextRange: TypeAlias = tuple[int, int]
"""Start and end (exclusive) within the expression's text, in characters."""
_WORDS: dict[str, LiteralValue] = {"null": None, "true": True, "false": False}
_OPERATORS: dict[type[ast.AST], str] = {
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
    ast.FloorDiv: "//",
    ast.Mod: "%",
    ast.Pow: "**",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.And: "and",
    ast.Or: "or",
    ast.Not: "not",
    ast.USub: "negative",
    ast.UAdd: "positive",
    ast.BitAnd: "&",
    ast.BitOr: "|",
    ast.BitXor: "^",
    ast.Invert: "~",
    ast.LShift: "<<",
    ast.RShift: ">>",
}
_PYTHON_ONLY: dict[type[ast.AST], str] = {
    ast.Is: "is_null(x) for null, `==` for other values",
    ast.IsNot: "not is_null(x) for null, `!=` for other values",
}
_REPLACEMENTS = {
    "&&": "write `and`",
    "||": "write `or`",
    "!": "write `not`",
    "===": "write `==`",
    "!==": "write `!=`",
    "=": "write `==` to compare",
    "?": "write `a if condition else b`",
}
"""Operators of C and JavaScript, which Python's parser rejects, and what to write instead."""
_FOREIGN_OPERATOR = re.compile(r"&&|\|\||[!=]==|\?|!(?!=)|(?<![=!<>*/%+-])=(?!=)")
_QUOTED = re.compile(r"'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\"")
_NOT_COMPARED = frozenset({"span", "name_span", "type", "text", "function"})
"""Fields that locate a node or follow from its other fields."""


class ExpressionError(Exception):
    """The text is not a valid expression; `span` is the offending part, `hint` the remedy."""

    def __init__(self, message: str, span: TextRange, hint: str | None = None) -> None:
        super().__init__(message)
        self.span = span
        self.hint = hint


class ExpressionNode(Struct, frozen=True, eq=False, dict=True):
    """A node of an expression; comparisons ignore positions, texts and derived types."""

    def __eq__(self, other: object) -> bool:
        """Return whether both nodes have the same class and equal content."""
        return type(self) is type(other) and self._content() == cast("ExpressionNode", other)._content()

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((type(self), self._content()))

    def _content(self) -> tuple[object, ...]:
        return tuple(getattr(self, name) for name in self.__struct_fields__ if name not in _NOT_COMPARED)


class Literal(ExpressionNode, frozen=True, eq=False):
    """A number, a text, `true`, `false` or `null`."""

    value: LiteralValue
    span: TextRange

    def _content(self) -> tuple[object, ...]:
        return (repr(self.value),)  # because True == 1 == 1.0, and 0.0 == -0.0


class Name(ExpressionNode, frozen=True, eq=False):
    """The name of a field or constant of the message."""

    name: str
    span: TextRange


class Attribute(ExpressionNode, frozen=True, eq=False):
    """`base.name`."""

    base: Node
    name: str
    span: TextRange
    name_span: TextRange


class EachElement(ExpressionNode, frozen=True, eq=False):
    """`base[]`: every element of a list."""

    base: Node
    span: TextRange


class Subscript(ExpressionNode, frozen=True, eq=False):
    """`base[index]`."""

    base: Node
    index: int
    span: TextRange


class ListLiteral(ExpressionNode, frozen=True, eq=False):
    """`[a, b, c]`."""

    items: tuple[Node, ...]
    span: TextRange


class Call(ExpressionNode, frozen=True, eq=False):
    """A function or operator by name (`sqrt`, `+`, `==`)."""

    name: str
    arguments: tuple[Node, ...]
    span: TextRange
    name_span: TextRange


class Ternary(ExpressionNode, frozen=True, eq=False):
    """`then if condition else otherwise`."""

    condition: Node
    then: Node
    otherwise: Node
    span: TextRange


Node: TypeAlias = "Literal | Name | Attribute | EachElement | Subscript | ListLiteral | Call | Ternary"


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


def parse(text: str) -> Node:
    """Parse an expression.

    Raises:
        ExpressionError: The text is not a valid expression.
    """
    if len(text) > MAX_CHARACTERS:
        raise ExpressionError(
            f"the expression has {len(text)} characters; {MAX_CHARACTERS} are allowed", (0, 1)
        )
    code, inserted = _rewrite_empty_brackets(text.replace("\n", " "))
    lead = len(code) - len(code.lstrip())
    code = code[lead:]
    if not code:
        raise ExpressionError("the expression is empty", (0, 1), "write a field's name, or null")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python warns about '\d', which regular expressions contain
            tree = ast.parse(code, mode="eval")
    except SyntaxError as error:
        raise _syntax_error(error, text, inserted, lead) from None
    except (ValueError, MemoryError, RecursionError):
        raise ExpressionError("the expression is nested too deeply", (0, len(text))) from None
    return _Parser(code, text, inserted, lead).translate(tree.body, 0)


def children(node: Node) -> tuple[Node, ...]:
    """Return the direct children of a node."""
    match node:
        case Attribute() | EachElement() | Subscript():
            return (node.base,)
        case ListLiteral():
            return node.items
        case Call():
            return node.arguments
        case Ternary():
            return (node.condition, node.then, node.otherwise)
        case _:
            return ()


def _rewrite_empty_brackets(text: str) -> tuple[str, list[int]]:
    """Rewrite `a[]` as `a[:]`, which Python can parse; return the positions of the inserted characters."""
    out: list[str] = []
    inserted: list[int] = []
    quote = ""
    for index, character in enumerate(text):
        if quote:
            quote = "" if character == quote and text[index - 1] != "\\" else quote
        elif character in "'\"":
            quote = character
        elif character == "]" and text[index - 1 : index] == "[":
            before = text[: index - 1].rstrip()[-1:]
            if before.isalnum() or before in {"_", "]", ")"}:
                inserted.append(len(out))
                out.append(":")
        out.append(character)
    return "".join(out), inserted


def _syntax_error(error: SyntaxError, text: str, inserted: list[int], lead: int) -> ExpressionError:
    foreign = _FOREIGN_OPERATOR.search(_QUOTED.sub(lambda match: "'" * len(match[0]), text))
    if foreign is not None:
        return ExpressionError(
            f"`{foreign[0]}` is not an operator of the language", foreign.span(), _REPLACEMENTS[foreign[0]]
        )
    last = max(len(text) - 1, 0)
    start = min(_original(error.offset - 1 + lead, inserted), last) if error.offset else last
    return ExpressionError(
        f"this is not an expression ({error.msg})",
        (start, start + 1),
        "put literal text in quotes; write a field named like a Python keyword as self['from']",
    )


def _original(position: int, inserted: list[int]) -> int:
    """Return a position in the text the user wrote, for a position after `_rewrite_empty_brackets`."""
    return position - sum(1 for index in inserted if index < position)


class _Parser:
    """Translates Python's syntax tree and rejects constructs that the language does not have."""

    def __init__(self, code: str, text: str, inserted: list[int], lead: int) -> None:
        self._bytes = code.encode()
        self._text = text
        self._inserted = inserted
        self._lead = lead
        self._translators: dict[type[ast.expr], Callable[..., Node]] = {
            ast.Constant: self._constant,
            ast.Name: self._name,
            ast.Attribute: self._attribute,
            ast.Subscript: self._subscript,
            ast.List: self._list,
            ast.UnaryOp: self._unary,
            ast.BinOp: self._binary,
            ast.BoolOp: self._logic,
            ast.Compare: self._compare,
            ast.IfExp: self._choice,
            ast.Call: self._call,
        }

    def translate(self, node: ast.expr, depth: int) -> Node:
        """Translate one node with its children."""
        translator = self._translators.get(type(node))
        if translator is None:
            raise ExpressionError(
                f"`{self._source(node)}` is not part of the language",
                self._span(node),
                "use operators, comparisons, `x if c else y` and the functions of the language",
            )
        if depth > MAX_DEPTH:
            raise ExpressionError(f"more than {MAX_DEPTH} levels of nesting", self._span(node))
        return translator(node, depth + 1)

    def _span(self, node: ast.expr) -> TextRange:
        end = len(self._bytes) if node.end_col_offset is None else node.end_col_offset
        return (self._position(node.col_offset), self._position(end))

    def _position(self, byte: int) -> int:
        # ast counts UTF-8 bytes within the line.
        return _original(len(self._bytes[:byte].decode()) + self._lead, self._inserted)

    def _source(self, node: ast.expr) -> str:
        start, end = self._span(node)
        return self._text[start:end]

    def _constant(self, node: ast.Constant, _: int) -> Node:
        if node.value is not None and not isinstance(node.value, (bool, int, float, str)):
            raise ExpressionError(
                f"`{self._source(node)}` is not a value of the language",
                self._span(node),
                "write a number, a text in quotes, true, false or null",
            )
        if isinstance(node.value, int) and not -(2**63) <= node.value < 2**64:
            raise ExpressionError(f"{node.value} has more than 64 bits", self._span(node))
        return Literal(node.value, self._span(node))

    def _name(self, node: ast.Name, _: int) -> Node:
        if node.id in _WORDS:
            return Literal(_WORDS[node.id], self._span(node))
        return Name(node.id, self._span(node))

    def _attribute(self, node: ast.Attribute, depth: int) -> Node:
        start, end = self._span(node)
        return Attribute(
            self.translate(node.value, depth), node.attr, (start, end), (end - len(node.attr), end)
        )

    def _subscript(self, node: ast.Subscript, depth: int) -> Node:
        base = self.translate(node.value, depth)
        span = self._span(node)
        match node.slice:
            case ast.Slice(lower=None, upper=None, step=None):
                return EachElement(base, span)
            case ast.Constant(value=str() as name):
                return Attribute(base, name, span, self._span(node.slice))
            case ast.Constant(value=int() as index) if not isinstance(index, bool):
                return Subscript(base, index, span)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as index)):
                return Subscript(base, -index, span)
            case ast.Slice(step=None):
                start = (
                    Literal(0, span) if node.slice.lower is None else self.translate(node.slice.lower, depth)
                )
                stop = () if node.slice.upper is None else (self.translate(node.slice.upper, depth),)
                return Call("slice", (base, start, *stop), span, span)
            case ast.Slice():
                raise ExpressionError(
                    "a slice has no step",
                    self._span(node.slice),
                    "write a[1:3] for a part of a list, reverse(a) for the opposite order",
                )
            case ast.Tuple():
                raise ExpressionError("a list has one index", self._span(node.slice), "write a[0][1]")
            case _:
                return Call("element", (base, self.translate(node.slice, depth)), span, span)

    def _list(self, node: ast.List, depth: int) -> Node:
        return ListLiteral(tuple(self.translate(item, depth) for item in node.elts), self._span(node))

    def _unary(self, node: ast.UnaryOp, depth: int) -> Node:
        span = self._span(node)
        operand = self.translate(node.operand, depth)
        if isinstance(node.op, ast.USub) and isinstance(operand, Literal):
            value = operand.value
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                return Literal(-value, span)
        return self._operation(node.op, (operand,), span)

    def _binary(self, node: ast.BinOp, depth: int) -> Node:
        return self._operation(
            node.op, (self.translate(node.left, depth), self.translate(node.right, depth)), self._span(node)
        )

    def _logic(self, node: ast.BoolOp, depth: int) -> Node:
        span = self._span(node)
        result = self.translate(node.values[0], depth)
        for value in node.values[1:]:
            result = self._operation(node.op, (result, self.translate(value, depth)), span)
        return result

    def _compare(self, node: ast.Compare, depth: int) -> Node:
        """Translate `a < b < c` to `a < b and b < c`."""
        span = self._span(node)
        left, result = node.left, None
        for operator, right in zip(node.ops, node.comparators, strict=True):
            if isinstance(operator, (ast.In, ast.NotIn)):
                pair = self._member(operator, left, right, depth)
            else:
                pair = self._operation(
                    operator, (self.translate(left, depth), self.translate(right, depth)), span
                )
            result = pair if result is None else Call("and", (result, pair), span, span)
            left = right
        return result or self.translate(left, depth)

    def _member(self, operator: ast.cmpop, left: ast.expr, right: ast.expr, depth: int) -> Node:
        """Translate `a in [b, c]` to `a == b or a == c`."""
        if not isinstance(right, ast.List) or not right.elts:
            hint = "write x in [1, 2], or any(list[] == x) to search a list"
            raise ExpressionError("`in` needs a list of values", self._span(right), hint)
        span = (self._span(left)[0], self._span(right)[1])
        value = self.translate(left, depth)
        pairs = [Call("==", (value, self.translate(item, depth)), span, span) for item in right.elts]
        result = pairs[0]
        for pair in pairs[1:]:
            result = Call("or", (result, pair), span, span)
        return Call("not", (result,), span, span) if isinstance(operator, ast.NotIn) else result

    def _operation(self, operator: ast.AST, arguments: tuple[Node, ...], span: TextRange) -> Node:
        name = _OPERATORS.get(type(operator))
        if name is None:
            instead = _PYTHON_ONLY.get(type(operator))
            raise ExpressionError(
                "this operator is not part of the language",
                span,
                f"write {instead}"
                if instead
                else "use + - * / // % ** == != < <= > >= in and or not; is_null(x) tests for null",
            )
        return Call(name, arguments, span, span)

    def _choice(self, node: ast.IfExp, depth: int) -> Node:
        parts = (self.translate(part, depth) for part in (node.test, node.body, node.orelse))
        return Ternary(*parts, span=self._span(node))

    def _call(self, node: ast.Call, depth: int) -> Node:
        span = self._span(node)
        if not isinstance(node.func, ast.Name):
            raise ExpressionError(
                "only functions can be called", self._span(node.func), "write len(x), not x.len()"
            )
        if node.keywords:
            raise ExpressionError(
                "functions take positional arguments only",
                self._span(node.keywords[0].value),
                "remove the name",
            )
        name, name_span = node.func.id, self._span(node.func)
        arguments = tuple(self.translate(argument, depth) for argument in node.args)
        if name == "if_else" and len(arguments) == 3:  # noqa: PLR2004 - condition, then, otherwise
            return Ternary(*arguments, span=span)
        return Call(name, arguments, span, name_span)
