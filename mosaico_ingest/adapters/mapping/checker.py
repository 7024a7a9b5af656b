"""Resolve the names and types of expressions, and report findings with their location."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.conversion import check_fits, element_type
from mosaico_ingest.adapters.mapping.expressions import (
    AnalyzedExpression,
    Cast,
    CloseList,
    Conditional,
    Constant,
    ElementAt,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import Parameter, check_call, suggest
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.adapters.mapping.parser import (
    Attribute,
    Call,
    EachElement,
    ExpressionError,
    ListLiteral,
    Literal,
    LiteralValue,
    Name,
    Node,
    Subscript,
    Ternary,
    TextRange,
    children,
    parse,
)
from mosaico_ingest.adapters.mapping.types import (
    ExprType,
    TypeMismatch,
    common_type,
    expr_type_of,
    format_type,
    is_list,
    is_number,
    list_type,
    narrowest_int,
)
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.rosbag.definitions.model import MessageType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath, Source

__all__ = [
    "CAST_TYPES",
    "SPECIAL_FORMS",
    "Analyzer",
    "Checker",
    "Report",
    "Scope",
    "Target",
    "typed_constant",
]

CAST_TYPES = {
    "bool": arrays.bool_(),
    **{
        f"{sign}int{bits}": getattr(arrays, f"{sign}int{bits}")()
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
    **{f"float{bits}": getattr(arrays, f"float{bits}")() for bits in (16, 32, 64)},
}
"""What `cast` makes, by its name in the language."""
_NUMBERS = {"nan": math.nan, "inf": math.inf, "pi": math.pi}

Report = Callable[[str, str, TextRange, "str | None"], None]
"""Takes a mistake: its rule, what, where in the expression, what to do."""
_UNKNOWN, _TYPE = "unknown-field", "operand-type"


class Scope(Struct, frozen=True):
    """Where names are looked up: a message and the types it is made of."""

    message: ExprType
    types: Mapping[str, MessageType]

    def field(self, expr_type: ExprType, name: str) -> ExprType | None:
        """Return the expr_type of a field of a message."""
        position = expr_type.arrow.get_field_index(name)
        if position < 0:
            return None
        known = self.types.get(expr_type.msgtype or "")
        declared = next((field for field in known.fields if field.name == name), None) if known else None
        msgtype = declared.type if declared is not None and declared.is_message else None
        return replace(
            expr_type_of(expr_type.arrow.field(position).type, msgtype=msgtype), axes=expr_type.axes
        )

    def constant(self, expr_type: ExprType, name: str) -> LiteralValue:
        """Return a constant of a message's type."""
        known = self.types.get(expr_type.msgtype or "")
        return next((c.value for c in known.constants if c.name == name), None) if known else None

    def names(self, expr_type: ExprType) -> list[str]:
        """Return the fields of a message."""
        return [field.name for field in expr_type.arrow]

    def describe(self, expr_type: ExprType, name: str) -> str:
        """Return the sentence for a field that is not there."""
        names = self.names(expr_type)
        near = suggest(name, names)
        listing = f"it has {', '.join(names)}" if names else "it has no fields"
        return f"{near} {listing}" if near else listing


def typed_constant(value: LiteralValue, text: str = "") -> Constant:
    """Return a literal as a typed value."""
    if value is None:
        return Constant(value, ExprType(arrays.null()), text)
    if isinstance(value, bool):
        return Constant(value, ExprType(arrays.bool_()), text)
    if isinstance(value, int):
        type_ = arrays.int64() if value < 2**63 else arrays.uint64()
        return Constant(value, ExprType(type_, bounds=(value, value)), text)
    if isinstance(value, float):
        return Constant(value, ExprType(arrays.float16()), text)  # its precision is what it meets
    return Constant(value, ExprType(arrays.string()), text)


class Checker:
    """Types the expressions of one scope; a mistake is reported once and poisons what is built on it."""

    def __init__(self, scope: Scope, report: Report, text: str) -> None:
        self._scope = scope
        self._report = report
        self._text = text
        self._readers: dict[type[Any], Callable[[Any], TypedExpression | None]] = {
            Literal: lambda node: typed_constant(node.value, self._source(node)),
            Name: self._name,
            Attribute: self._attribute,
            EachElement: self._each,
            Subscript: self._item,
            ListLiteral: self._list,
            Ternary: self._choice,
            Call: self._call,
        }

    def infer(self, node: Node) -> TypedExpression | None:
        """Return the typed expression, or None after a report."""
        return self._readers[type(node)](node)

    def _fail(self, message: str, place: TextRange, hint: str | None = None, *, rule: str = _TYPE) -> None:
        self._report(rule, message, place, hint)

    def _source(self, node: Node) -> str:
        return self._text[node.span[0] : node.span[1]]

    def _name(self, node: Name) -> TypedExpression | None:
        scope = self._scope
        field = scope.field(scope.message, node.name)
        if node.name == "self" and field is None:
            return MessageRef(scope.message)
        if field is not None:
            return FieldAccess(MessageRef(scope.message), node.name, field, node.name)
        value = scope.constant(scope.message, node.name)
        value = _NUMBERS.get(node.name) if value is None else value
        if value is not None:
            return typed_constant(value, node.name)
        what = f"no field {node.name!r} in {format_type(scope.message)}"
        self._fail(what, node.span, scope.describe(scope.message, node.name), rule=_UNKNOWN)
        return None

    def _attribute(self, node: Attribute) -> TypedExpression | None:
        of = self.infer(node.base)
        if of is None:
            return None
        element = of.type.element
        if not pt.is_struct(element.arrow):
            hint = f"write {of.text}[].{node.name}" if is_list(element.arrow) else None
            self._fail(f"`{of.text}` is {format_type(element)}, it has no fields", node.name_span, hint)
            return None
        field = self._scope.field(of.type, node.name)
        if field is not None:
            return FieldAccess(of, node.name, field, self._source(node))
        value = self._scope.constant(element, node.name)
        if value is not None:
            return typed_constant(value, self._source(node))
        what = f"no field {node.name!r} in `{of.text}` ({format_type(element)})"
        self._fail(what, node.name_span, self._scope.describe(element, node.name), rule=_UNKNOWN)
        return None

    def _listed(self, node: EachElement | Subscript) -> TypedExpression | None:
        of = self.infer(node.base)
        if of is not None and not is_list(of.type.arrow):
            self._fail(f"`{of.text}` is {format_type(of.type.element)}, not a list", node.span)
            return None
        return of

    def _each(self, node: EachElement) -> TypedExpression | None:
        of = self._listed(node)
        if of is None:
            return None
        type_ = of.type.arrow
        size = type_.list_size if pt.is_fixed_size_list(type_) else None
        expr_type = expr_type_of(type_.value_type, msgtype=of.type.msgtype)
        return OpenList(of, replace(expr_type, axes=(*of.type.axes, size)), self._source(node))

    def _item(self, node: Subscript) -> TypedExpression | None:
        of = self._listed(node)
        if of is None:
            return None
        expr_type = expr_type_of(of.type.arrow.value_type, msgtype=of.type.msgtype)
        return ElementAt(of, node.index, replace(expr_type, axes=of.type.axes), self._source(node))

    def _list(self, node: ListLiteral) -> TypedExpression | None:
        items = self._all(node.items)
        if items is None:
            return None
        if not items:
            return MakeList((), ExprType(arrays.list_(arrays.null())), self._source(node))
        joined = self._joined(items, node)
        if joined is None:
            return None
        element = narrowest_int(joined.bounds) if joined.bounds else joined.arrow
        expr_type = ExprType(list_type(element, len(items)), axes=_deepest(items), msgtype=joined.msgtype)
        return MakeList(items, expr_type, self._source(node))

    def _all(self, nodes: tuple[Node, ...]) -> tuple[TypedExpression, ...] | None:
        """Infer all, so that each mistake is reported; None if there was one."""
        typed = [self.infer(node) for node in nodes]
        good = tuple(value for value in typed if value is not None)
        return good if len(good) == len(typed) else None

    def _joined(self, values: tuple[TypedExpression, ...], node: Node) -> ExprType | None:
        try:
            return common_type([value.type.element for value in values])
        except TypeMismatch as unfit:
            self._fail(str(unfit), node.span, unfit.hint)
            return None

    def _choice(self, node: Ternary) -> TypedExpression | None:
        parts = self._all((node.condition, node.then, node.otherwise))
        if parts is None:
            return None
        condition, then, otherwise = parts
        if not (pt.is_boolean(condition.type.arrow) or pt.is_null(condition.type.arrow)):
            what = (
                f"a condition is true or false, `{condition.text}` is {format_type(condition.type.element)}"
            )
            self._fail(what, node.condition.span, "compare it: x != 0")
            return None
        joined = self._joined((then, otherwise), node)
        if joined is None:
            return None
        return Conditional(*parts, type=replace(joined, axes=_deepest(parts)), text=self._source(node))

    def _cast(self, node: Call) -> TypedExpression | None:
        if len(node.arguments) != 2:  # noqa: PLR2004 - value and type
            self._fail(
                "inside an expression cast(x, 'type') needs the type",
                node.span,
                f"one of {', '.join(CAST_TYPES)}",
            )
            return None
        of = self.infer(node.arguments[0])
        wanted = node.arguments[1]
        type_ = CAST_TYPES.get(str(wanted.value)) if isinstance(wanted, Literal) else None
        if type_ is None:
            self._fail("cast makes " + ", ".join(CAST_TYPES), wanted.span, "write the type in quotes")
            return None
        return None if of is None else self.cast(of, type_, node)

    def cast(self, of: TypedExpression, type_: Any, node: Node) -> TypedExpression | None:  # noqa: ANN401 - an Arrow type
        """Return a value as another number type, checked for each row."""
        element = of.type.arrow
        if not (is_number(element) or pt.is_boolean(element) or pt.is_null(element)):
            self._fail(
                f"cast takes a number, `{of.text}` is {format_type(of.type.element)}",
                node.span,
                "number(x) reads text",
            )
            return None
        return Cast(of, type_, replace(expr_type_of(type_), axes=of.type.axes), self._source(node))

    def _either(self, node: Call) -> TypedExpression | None:
        """Take the first argument whose fields exist; where none does, the last says what is there."""
        for argument in node.arguments[:-1]:
            mistakes: list[str] = []
            quiet = Checker(self._scope, _noting(mistakes), self._text)
            typed = quiet.infer(argument)
            if typed is not None or set(mistakes) != {_UNKNOWN}:
                return typed or self.infer(argument)
        return self.infer(node.arguments[-1])

    def _call(self, node: Call) -> TypedExpression | None:
        if node.name in {"cast", "either"}:
            return self._cast(node) if node.name == "cast" else self._either(node)
        function = lookup(node.name)
        arguments = self._all(node.arguments)
        if function is None or arguments is None:
            return None  # an unknown function was reported when the file was read
        arguments = tuple(_folded(a, function.parameter(i).takes) for i, a in enumerate(arguments))
        for position, argument in enumerate(arguments):
            problem = _literal_problem(function.parameter(position), argument)
            if problem is not None:
                self._fail(f"{node.name} {problem}", node.arguments[position].span)
                return None
        try:
            expr_type = check_call(function, [argument.type.element for argument in arguments])
        except TypeMismatch as unfit:
            blamed = node if unfit.argument is None else node.arguments[unfit.argument]
            self._fail(str(unfit), blamed.span, unfit.hint)
            return None
        if pt.is_null(expr_type.arrow):
            return typed_constant(None, self._source(node))
        expr_type = replace(expr_type, axes=_deepest(arguments))
        return FunctionCall(node.name, function, arguments, expr_type, self._source(node))


def _noting(rules: list[str]) -> Report:
    """Return a report that only keeps the rules that were broken."""

    def note(rule: str, message: str, place: TextRange, hint: str | None) -> None:  # noqa: ARG001 - a report's arguments
        rules.append(rule)

    return note


def _literal_problem(take: Parameter, argument: TypedExpression) -> str | None:
    """Return what is wrong with an argument that has to be written out."""
    if not take.literal:
        return None
    if not isinstance(argument, Constant) or not isinstance(argument.value, str):
        return f"takes {take.description} here"
    problem = take.check_literal(argument.value) if take.check_literal else None
    return f"cannot take this: {problem}" if problem else None


def _folded(value: TypedExpression, takes: Callable[[ExprType], bool]) -> TypedExpression:
    """Close the innermost open list if the function takes the list, not its elements."""
    if not value.type.axes or takes(value.type.element):
        return value
    folded = value.type.close_innermost()
    return CloseList(value, folded, value.text) if takes(folded.element) else value


def _deepest(values: tuple[TypedExpression, ...]) -> tuple[int | None, ...]:
    """Return the open lists of the value that has most."""
    return max((value.type.axes for value in values), key=len, default=())


SPECIAL_FORMS = {
    "cast": (1, 2, "cast(x) or cast(x, 'int32')"),
    "either": (2, 99, "either(a, b, …)"),
    "if_else": (3, 3, "if_else(condition, then, otherwise)"),
}
"""What looks like a function and is not: fewest and most arguments, spelling."""


class Target(Struct, frozen=True):
    """A column to be filled: what it must be, where the file says so, and where names are read."""

    name: str
    """With those around it, as `pose.position`; empty for the record."""
    type: DataType
    path: KeyPath
    scope: Scope | None
    """None while there is no message to look at."""
    title: str
    """What messages call it."""

    def at(self, *keys: str) -> Target:
        """Return the slot with the place of a key inside its value."""
        return replace(self, path=(*self.path, *keys))

    def inside(self, name: str) -> str:
        """Return what a field of this column is called."""
        return f"{self.name}.{name}" if self.name else name


class Analyzer:
    """Analyses the expressions of one file; `findings` holds what is wrong with it so far."""

    def __init__(self, source: Callable[[], Source]) -> None:
        self.findings: list[Finding] = []
        self._source = source

    def report(
        self, path: KeyPath, message: str, help_: str | None = None, *, rule: str = "adapter-file"
    ) -> None:
        """Note a mistake about a key or value."""
        self.findings.append(Finding(rule, Severity.ERROR, message, self._source().key_span(path), help_))

    def report_inside(
        self, path: KeyPath, place: TextRange, rule: str, message: str, help_: str | None
    ) -> None:
        """Note a mistake in a part of an expression."""
        span = self._source().inner_span(path, *place)
        self.findings.append(Finding(rule, Severity.ERROR, message, span, help_))

    def report_mismatch(self, at: AnalyzedExpression | KeyPath, unfit: TypeMismatch) -> None:
        """Note that a value does not fit."""
        if isinstance(at, AnalyzedExpression):
            self.report_inside(at.path, at.node.span, "type-mismatch", str(unfit), unfit.hint)
        else:
            span = self._source().span(at)
            self.findings.append(Finding("type-mismatch", Severity.ERROR, str(unfit), span, unfit.hint))

    def check_fits(self, at: AnalyzedExpression | KeyPath, expr_type: ExprType, target: DataType) -> bool:
        """Check that values fit a column; otherwise note it."""
        return self._attempt(at, lambda: (check_fits(expr_type, target), True)[1]) is not None

    def element_type(
        self, at: AnalyzedExpression | KeyPath, expr_type: ExprType, target: DataType
    ) -> DataType | None:
        """Return what an element of open lists must be; None after a finding."""
        return self._attempt(at, lambda: element_type(target, expr_type.axes))

    def _attempt(self, at: AnalyzedExpression | KeyPath, run: Callable[[], Any]) -> Any:  # noqa: ANN401 - what run returns
        """Return the result of a check, or None after a finding."""
        try:
            return run()
        except TypeMismatch as unfit:
            self.report_mismatch(at, unfit)
            return None

    def expression(self, path: KeyPath, text: str, scope: Scope | None) -> AnalyzedExpression | None:
        """Read and type an expression; None after a finding."""
        try:
            node = parse(text)
        except ExpressionError as error:
            self.report_inside(path, error.span, "expression-syntax", str(error), error.hint)
            return None
        known = len(self.findings)
        self._check_calls(path, node)
        if len(self.findings) > known:
            return None
        if scope is None:
            return AnalyzedExpression(path, text, node, None)
        typed = self.checker(path, text, scope).infer(without_cast(node))
        return None if typed is None else AnalyzedExpression(path, text, node, typed)

    def scalar(
        self, path: KeyPath, value: Scalar, scope: Scope | None
    ) -> AnalyzedExpression | Constant | None:
        """Compile a plain value: text is an expression, anything else itself."""
        return (
            self.expression(path, value, scope)
            if isinstance(value, str)
            else typed_constant(value, str(value))
        )

    def checker(self, path: KeyPath, text: str, scope: Scope) -> Checker:
        """Return what types expressions at a path."""

        def report(rule: str, message: str, place: TextRange, help_: str | None) -> None:
            self.report_inside(path, place, rule, message, help_)

        return Checker(scope, report, text)

    def cast(self, written: AnalyzedExpression, slot: Target) -> TypedExpression | None:
        """Apply `cast(x)`: to whatever number the column is."""
        if written.typed is None or slot.scope is None:
            return None
        element = self.element_type(written, written.typed.type, slot.type)
        if element is None:
            return None
        if pt.is_nested(element) or pt.is_string(element) or pt.is_binary(element):
            message = f"cast makes numbers and booleans, the target is {format_type(element)}"
            self.report_inside(written.path, written.node.span, "type-mismatch", message, None)
            return None
        checker = self.checker(written.path, written.text, slot.scope)
        return checker.cast(written.typed, element, written.node)

    def inside(self, of: AnalyzedExpression | None, scope: Scope | None) -> Scope | None:
        """Return the scope of the message that `of` gives; the outer one where nothing is said."""
        if of is None or scope is None:
            return scope
        if of.typed is None:
            return None
        element = of.typed.type.element
        if pt.is_struct(element.arrow):
            return replace(scope, message=element)
        hint = f"write {of.typed.text}[]" if is_list(element.arrow) else None
        message = f"`{of.typed.text}` is {format_type(element)}, not a message"
        self.report_inside(of.path, of.node.span, "operand-type", message, hint)
        return None

    def _check_calls(self, path: KeyPath, node: Node) -> None:
        if isinstance(node, Call):
            self._check_call(path, node)
        for child in children(node):
            self._check_calls(path, child)

    def _check_call(self, path: KeyPath, node: Call) -> None:
        if node.name in SPECIAL_FORMS:
            fewest, most, spelling = SPECIAL_FORMS[node.name]
            if not fewest <= len(node.arguments) <= most:
                message = f"it is written {spelling}"
                self.report_inside(path, node.span, "function-arguments", message, None)
            return
        function = lookup(node.name)
        if function is None:
            near = suggest(node.name, [*(known.name for known in functions()), *SPECIAL_FORMS])
            message = f"there is no function {node.name!r}"
            self.report_inside(path, node.name_span, "unknown-function", message, near)
        elif problem := function.arity_problem(len(node.arguments)):
            self.report_inside(path, node.span, "function-arguments", problem, None)


def is_short_cast(node: Node) -> bool:
    """Return whether an expression is `cast(x)`, to the type of what it fills."""
    return isinstance(node, Call) and node.name == "cast" and len(node.arguments) == 1


def without_cast(node: Node) -> Node:
    """Return x of `cast(x)`, any other expression as it is."""
    return node.arguments[0] if isinstance(node, Call) and is_short_cast(node) else node
