"""This file reads the text of an expression into a small tree; it is parsed as Python and never run as Python."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Callable
from typing import TypeAlias, cast

from msgspec import Struct

__all__ = [
    "Attribute",
    "Call",
    "EachElement",
    "ExpressionError",
    "ExpressionNode",
    "ListLiteral",
    "Literal",
    "LiteralValue",
    "Name",
    "Node",
    "Subscript",
    "Ternary",
    "TextRange",
    "children",
    "parse",
]

MAX_CHARACTERS = 4000
MAX_DEPTH = 60

LiteralValue: TypeAlias = "bool | int | float | str | None"
TextRange: TypeAlias = tuple[int, int]
"""First character and one past the last, within the expression's text."""


_NOT_COMPARED = frozenset({"span", "name_span", "type", "text", "function"})
"""Fields that locate a node or follow from its other fields."""


class ExpressionError(Exception):
    """The text is not an expression of this language; `place` says which part, `help` what to write."""

    def __init__(self, message: str, place: TextRange, hint: str | None = None) -> None:
        super().__init__(message)
        self.span = place
        self.hint = hint


class ExpressionNode(Struct, frozen=True, eq=False):
    """A node of an expression; positions, texts and derived types do not take part in comparisons."""

    def __eq__(self, other: object) -> bool:
        """Return whether both nodes are of one class and have equal content."""
        return type(self) is type(other) and self._content() == cast("ExpressionNode", other)._content()

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash((type(self), self._content()))

    def _content(self) -> tuple[object, ...]:
        return tuple(getattr(self, name) for name in self.__struct_fields__ if name not in _NOT_COMPARED)


class Literal(ExpressionNode, frozen=True, eq=False):
    """A number, text, `true`, `false` or `null`."""

    value: LiteralValue
    span: TextRange


class Name(ExpressionNode, frozen=True, eq=False):
    """A field or constant of the message."""

    name: str
    span: TextRange


class Attribute(ExpressionNode, frozen=True, eq=False):
    """`of.name`."""

    base: Node
    name: str
    span: TextRange
    name_span: TextRange


class EachElement(ExpressionNode, frozen=True, eq=False):
    """`of[]`: every element of a list."""

    base: Node
    span: TextRange


class Subscript(ExpressionNode, frozen=True, eq=False):
    """`of[index]`."""

    base: Node
    index: int
    span: TextRange


class ListLiteral(ExpressionNode, frozen=True, eq=False):
    """`[a, b, c]`."""

    items: tuple[Node, ...]
    span: TextRange


class Call(ExpressionNode, frozen=True, eq=False):
    """A function or an operator, by its name (`sqrt`, `+`, `==`)."""

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
}


def parse(text: str) -> Node:
    """Read an expression.

    Raises:
        ExpressionError: It is none; the place is the offending part.
    """
    if len(text) > MAX_CHARACTERS:
        raise ExpressionError(
            f"the expression has {len(text)} characters; {MAX_CHARACTERS} are allowed", (0, 1)
        )
    code, moved = _rewrite_empty_brackets(text.replace("\n", " "))
    lead = len(code) - len(code.lstrip())
    code = code[lead:]
    if not code:
        raise ExpressionError("the expression is empty", (0, 1), "write a field's name, or null")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # '\d' in a pattern is meant as it stands
            tree = ast.parse(code, mode="eval")
    except SyntaxError as error:
        raise _syntax_error(error, text, moved, lead) from None
    except (ValueError, MemoryError, RecursionError):
        raise ExpressionError("the expression cannot be read: it nests too deeply", (0, len(text))) from None
    return _Parser(code, text, moved, lead).parse(tree.body, 0)


def children(node: Node) -> tuple[Node, ...]:
    """Return the nodes directly below."""
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
    """Spell `a[]` as `a[:]`, which Python can read; return where characters were put in."""
    out: list[str] = []
    moved: list[int] = []
    quote = ""
    for index, character in enumerate(text):
        if quote:
            quote = "" if character == quote and text[index - 1] != "\\" else quote
        elif character in "'\"":
            quote = character
        elif character == "]" and text[index - 1 : index] == "[":
            before = text[: index - 1].rstrip()[-1:]
            if before.isalnum() or before in {"_", "]", ")"}:
                moved.append(len(out))
                out.append(":")
        out.append(character)
    return "".join(out), moved


def _syntax_error(error: SyntaxError, text: str, moved: list[int], lead: int) -> ExpressionError:
    last = max(len(text) - 1, 0)
    at = min(_original(error.offset - 1 + lead, moved), last) if error.offset else last
    return ExpressionError(
        f"this is not an expression ({error.msg})",
        (at, at + 1),
        "text needs quotes of its own, a field named like a Python keyword is self['from']",
    )


def _original(position: int, moved: list[int]) -> int:
    return position - sum(1 for put_in in moved if put_in < position)


class _Parser:
    """Turns Python's tree into ours, refusing what the language does not have."""

    def __init__(self, code: str, text: str, moved: list[int], lead: int) -> None:
        self._bytes = code.encode()
        self._text = text
        self._moved = moved
        self._lead = lead
        self._readers: dict[type[ast.expr], Callable[..., Node]] = {
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

    def parse(self, node: ast.expr, depth: int) -> Node:
        """Read one node and all below."""
        reader = self._readers.get(type(node))
        if reader is None:
            raise ExpressionError(
                f"`{self._source(node)}` is not part of the language",
                self._place(node),
                "use operators, comparisons, `x if c else y` and the listed functions",
            )
        if depth > MAX_DEPTH:
            raise ExpressionError(f"more than {MAX_DEPTH} levels of nesting", self._place(node))
        return reader(node, depth + 1)

    def _place(self, node: ast.expr) -> TextRange:
        end = len(self._bytes) if node.end_col_offset is None else node.end_col_offset
        return (self._position(node.col_offset), self._position(end))

    def _position(self, byte: int) -> int:
        # ast counts UTF-8 bytes; what was read is one line
        return _original(len(self._bytes[:byte].decode()) + self._lead, self._moved)

    def _source(self, node: ast.expr) -> str:
        start, end = self._place(node)
        return self._text[start:end]

    def _constant(self, node: ast.Constant, _: int) -> Node:
        if node.value is not None and not isinstance(node.value, (bool, int, float, str)):
            raise ExpressionError(
                f"`{self._source(node)}` is no value of the language",
                self._place(node),
                "write a number, text in quotes, true, false or null",
            )
        if isinstance(node.value, int) and not -(2**63) <= node.value < 2**64:
            raise ExpressionError(f"{node.value} has more than 64 bits", self._place(node))
        return Literal(node.value, self._place(node))

    def _name(self, node: ast.Name, _: int) -> Node:
        if node.id in _WORDS:
            return Literal(_WORDS[node.id], self._place(node))
        return Name(node.id, self._place(node))

    def _attribute(self, node: ast.Attribute, depth: int) -> Node:
        start, end = self._place(node)
        return Attribute(self.parse(node.value, depth), node.attr, (start, end), (end - len(node.attr), end))

    def _subscript(self, node: ast.Subscript, depth: int) -> Node:
        of = self.parse(node.value, depth)
        place = self._place(node)
        match node.slice:
            case ast.Slice(lower=None, upper=None, step=None):
                return EachElement(of, place)
            case ast.Constant(value=str() as name):
                return Attribute(of, name, place, self._place(node.slice))
            case ast.Constant(value=int() as index) if not isinstance(index, bool):
                return Subscript(of, index, place)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() as index)):
                return Subscript(of, -index, place)
            case _:
                raise ExpressionError(
                    "an index is a number",
                    self._place(node.slice),
                    "write a[] for each element, a[0] for the first, a[-1] for the last",
                )

    def _list(self, node: ast.List, depth: int) -> Node:
        return ListLiteral(tuple(self.parse(item, depth) for item in node.elts), self._place(node))

    def _unary(self, node: ast.UnaryOp, depth: int) -> Node:
        place = self._place(node)
        operand = self.parse(node.operand, depth)
        if isinstance(node.op, ast.USub) and isinstance(operand, Literal):
            value = operand.value
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                return Literal(-value, place)
        return self._operation(node.op, (operand,), place)

    def _binary(self, node: ast.BinOp, depth: int) -> Node:
        return self._operation(
            node.op, (self.parse(node.left, depth), self.parse(node.right, depth)), self._place(node)
        )

    def _logic(self, node: ast.BoolOp, depth: int) -> Node:
        place = self._place(node)
        result = self.parse(node.values[0], depth)
        for value in node.values[1:]:
            result = self._operation(node.op, (result, self.parse(value, depth)), place)
        return result

    def _compare(self, node: ast.Compare, depth: int) -> Node:
        """`a < b < c` is `a < b and b < c`."""
        place = self._place(node)
        left, result = node.left, None
        for operator, right in zip(node.ops, node.comparators, strict=True):
            if isinstance(operator, (ast.In, ast.NotIn)):
                pair = self._member(operator, left, right, depth)
            else:
                pair = self._operation(operator, (self.parse(left, depth), self.parse(right, depth)), place)
            result = pair if result is None else Call("and", (result, pair), place, place)
            left = right
        return result or self.parse(left, depth)

    def _member(self, operator: ast.cmpop, left: ast.expr, right: ast.expr, depth: int) -> Node:
        """`a in [b, c]` is `a == b or a == c`."""
        if not isinstance(right, ast.List) or not right.elts:
            hint = "as status in [1, 2]; any(a[] == b) looks into a list"
            raise ExpressionError("`in` needs a list of values", self._place(right), hint)
        place = (self._place(left)[0], self._place(right)[1])
        value = self.parse(left, depth)
        pairs = [Call("==", (value, self.parse(item, depth)), place, place) for item in right.elts]
        result = pairs[0]
        for pair in pairs[1:]:
            result = Call("or", (result, pair), place, place)
        return Call("not", (result,), place, place) if isinstance(operator, ast.NotIn) else result

    def _operation(self, operator: ast.AST, arguments: tuple[Node, ...], place: TextRange) -> Node:
        name = _OPERATORS.get(type(operator))
        if name is None:
            raise ExpressionError(
                "this operator is not part of the language",
                place,
                "there are + - * / // % ** == != < <= > >= in and or not; is_null(x) for null",
            )
        return Call(name, arguments, place, place)

    def _choice(self, node: ast.IfExp, depth: int) -> Node:
        parts = (self.parse(part, depth) for part in (node.test, node.body, node.orelse))
        return Ternary(*parts, span=self._place(node))

    def _call(self, node: ast.Call, depth: int) -> Node:
        place = self._place(node)
        if not isinstance(node.func, ast.Name):
            raise ExpressionError(
                "only a function can be called", self._place(node.func), "write len(x), not x.len()"
            )
        if node.keywords:
            raise ExpressionError(
                "arguments are given by position", self._place(node.keywords[0].value), "drop the name"
            )
        name, at = node.func.id, self._place(node.func)
        arguments = tuple(self.parse(argument, depth) for argument in node.args)
        if name == "if_else" and len(arguments) == 3:  # noqa: PLR2004 - condition, then, otherwise
            return Ternary(*arguments, span=place)
        return Call(name, arguments, place, at)
