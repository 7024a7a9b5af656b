"""Parse and type-check the expressions of an adapter file, and collect the findings with their location."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import (
    DataType,
    ExprType,
    TypeMismatch,
    arrays,
    common_type,
    expr_type_of,
    format_type,
    is_list,
    is_number,
    list_type,
    narrowest_int,
    pt,
)
from mosaico_ingest.adapters.mapping.conversion import check_fits, element_type
from mosaico_ingest.adapters.mapping.expressions import (
    AnalyzedExpression,
    Attribute,
    Call,
    Cast,
    CloseList,
    Conditional,
    Constant,
    EachElement,
    ElementAt,
    EnvelopeField,
    ExpressionError,
    FieldAccess,
    FunctionCall,
    ListLiteral,
    Literal,
    LiteralValue,
    MakeList,
    MessageRef,
    Name,
    Node,
    OpenList,
    OuterValue,
    Subscript,
    Ternary,
    TextRange,
    TypedExpression,
    children,
    parse,
)
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import (
    Function,
    Parameter,
    check_call,
    suggest,
    suggest_synonym,
)
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.rosbag.definitions.model import MessageType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath, Source

CAST_TYPES = {
    "bool": arrays.bool_(),
    **{
        f"{sign}int{bits}": getattr(arrays, f"{sign}int{bits}")()
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
    **{f"float{bits}": getattr(arrays, f"float{bits}")() for bits in (16, 32, 64)},
}
"""The types that `cast` converts to, by their name in the language."""
_NUMBERS = {"nan": math.nan, "inf": math.inf, "pi": math.pi}

Report = Callable[[str, str, TextRange, "str | None"], None]
"""Receives a mistake: rule id, message, text range in the expression, hint."""
_UNKNOWN_FIELD, _OPERAND_TYPE = "unknown-field", "operand-type"
ENVELOPE_NAME = "message"
"""The name before the properties of a message besides its content."""
ENVELOPE_FIELDS = {
    "log_time": expr_type_of(arrays.int64()),
    "publish_time": expr_type_of(arrays.int64()),
    "topic": expr_type_of(arrays.string()),
    "sequence": expr_type_of(arrays.uint32()),
}
"""The properties of a message besides its content, by name; times are in ns since the epoch."""
RESERVED_NAMES = frozenset({"self", ENVELOPE_NAME, *_NUMBERS})
"""Names that bindings cannot have."""


class Binding(Struct, frozen=True):
    """A named value of an adapter file: a parameter, or a binding of `let`."""

    typed: TypedExpression
    depth: int
    """The number of scopes around the one in which the value is computed."""


class Scope(Struct, frozen=True):
    """The message in which names are looked up, and the definitions of its types."""

    message: ExprType
    types: Mapping[str, MessageType]
    bindings: Mapping[str, Binding] = {}
    depth: int = 0
    """The number of messages around this one, whose values are `OuterValue`s here."""
    has_envelope: bool = False
    """Whether expressions can use the properties of messages besides their content."""
    subject: TypedExpression | None = None
    """The elements in which names are looked up first, in the scope of an element."""
    enclosing: Scope | None = None
    """The scope in which names are looked up next, in the scope of an element."""

    def nested(self, message: ExprType) -> Scope:
        """Return the scope of a nested message."""
        return replace(self, message=message, depth=self.depth + 1)

    def of_elements(self, elements: TypedExpression) -> Scope:
        """Return the scope of the elements of a list, in which names of the enclosing scope are visible."""
        return replace(self, message=elements.type, subject=elements, enclosing=self)

    def bound(self, name: str) -> TypedExpression | None:
        """Return the value of a binding, None if there is none of this name."""
        binding = self.bindings.get(name)
        if binding is None:
            return None
        levels = self.depth - binding.depth
        if levels == 0 or isinstance(binding.typed, Constant):
            return replace(binding.typed, text=name)
        return OuterValue(binding.typed, levels, binding.typed.type.close_all(), name)

    def field(self, message: ExprType, name: str) -> ExprType | None:
        """Return the type of a field of a message, None if it has no such field."""
        position = message.arrow.get_field_index(name) if pt.is_struct(message.arrow) else -1
        if position < 0:
            return None
        definition = self.types.get(message.msgtype or "")
        fields = definition.fields if definition else ()
        field = next((field for field in fields if field.name == name), None)
        msgtype = field.type if field is not None and field.is_message else None
        arrow = message.arrow.field(position).type
        return replace(expr_type_of(arrow, msgtype=msgtype), axes=message.axes)

    def constants(self, message: ExprType) -> Mapping[str, LiteralValue]:
        """Return the constants of a message's type."""
        definition = self.types.get(message.msgtype or "")
        return {constant.name: constant.value for constant in definition.constants} if definition else {}

    def suggest_name(self, message: ExprType, name: str) -> str:
        """Return the hint for a name that is neither a field nor a constant of a message."""
        fields = [field.name for field in message.arrow] if pt.is_struct(message.arrow) else []
        nearest = suggest(name, [*fields, *self.constants(message)])
        listing = f"it has {', '.join(fields)}" if fields else "it has no fields"
        return f"{nearest} {listing}" if nearest else listing


def typed_constant(value: LiteralValue, text: str = "") -> Constant:
    """Return a literal as a typed expression."""
    if value is None:
        return Constant(value, ExprType(arrays.null()), text)
    if isinstance(value, bool):
        return Constant(value, ExprType(arrays.bool_()), text)
    if isinstance(value, int):
        type_ = arrays.int64() if value < 2**63 else arrays.uint64()
        return Constant(value, ExprType(type_, bounds=(value, value)), text)
    if isinstance(value, float):
        # A literal takes the width of the fields it is combined with, so it starts with the narrowest.
        return Constant(value, ExprType(arrays.float16()), text)
    return Constant(value, ExprType(arrays.string()), text)


class Checker:
    """Types the expressions of one scope.

    A node with a mistake has no type, and neither has any node above it, so that each mistake is reported once.
    """

    def __init__(self, scope: Scope, report: Report, text: str) -> None:
        self._scope = scope
        self._report = report
        self._text = text
        self._rules: dict[type[Any], Callable[[Any], TypedExpression | None]] = {
            Literal: lambda node: typed_constant(node.value, self._source(node)),
            Name: self._name,
            Attribute: self._attribute,
            EachElement: self._each_element,
            Subscript: self._subscript,
            ListLiteral: self._list,
            Ternary: self._ternary,
            Call: self._call,
        }

    def infer(self, node: Node) -> TypedExpression | None:
        """Return the typed expression, or None after a report."""
        return self._rules[type(node)](node)

    def cast(self, operand: TypedExpression, target: DataType, node: Node) -> TypedExpression | None:
        """Return a number as another type, checked for each row; None after a report."""
        arrow = operand.type.arrow
        if not (is_number(arrow) or pt.is_boolean(arrow) or pt.is_null(arrow)):
            message = f"cast takes a number, `{operand.text}` is {format_type(operand.type.element)}"
            self._fail(message, node.span, "use number(x) to parse text")
            return None
        return Cast(
            operand, target, replace(expr_type_of(target), axes=operand.type.axes), self._source(node)
        )

    def _fail(
        self, message: str, span: TextRange, hint: str | None = None, *, rule: str = _OPERAND_TYPE
    ) -> None:
        self._report(rule, message, span, hint)

    def _source(self, node: Node) -> str:
        return self._text[node.span[0] : node.span[1]]

    def _name(self, node: Name) -> TypedExpression | None:
        scope = self._scope
        typed = _resolve(scope, node.name)
        if typed is not None:
            return typed
        element = scope.message.element
        message = f"no field {node.name!r} in {format_type(element)}"
        hint = suggest(node.name, scope.bindings) or scope.suggest_name(element, node.name)
        if node.name == ENVELOPE_NAME and scope.has_envelope:
            hint = f"write {', '.join(f'{ENVELOPE_NAME}.{name}' for name in ENVELOPE_FIELDS)}"
        self._fail(message, node.span, hint, rule=_UNKNOWN_FIELD)
        return None

    def _envelope_field(self, node: Attribute) -> TypedExpression | None:
        """Return a property such as `message.log_time`, None if the name means a field of the message."""
        is_message = isinstance(node.base, Name) and node.base.name == ENVELOPE_NAME
        if not (is_message and self._scope.has_envelope):
            return None
        expr_type = ENVELOPE_FIELDS.get(node.name)
        field = _resolve(self._scope, ENVELOPE_NAME)
        if expr_type is None or (field is not None and self._scope.field(field.type, node.name) is not None):
            return None
        return EnvelopeField(node.name, expr_type, self._source(node))

    def _attribute(self, node: Attribute) -> TypedExpression | None:
        envelope_field = self._envelope_field(node)
        if envelope_field is not None:
            return envelope_field
        base = self.infer(node.base)
        if base is None:
            return None
        element = base.type.element
        if not pt.is_struct(element.arrow):
            hint = f"write {base.text}[].{node.name}" if is_list(element.arrow) else None
            self._fail(f"`{base.text}` is {format_type(element)}, it has no fields", node.name_span, hint)
            return None
        field = self._scope.field(base.type, node.name)
        if field is not None:
            return FieldAccess(base, node.name, field, self._source(node))
        value = self._scope.constants(element).get(node.name)
        if value is not None:
            return typed_constant(value, self._source(node))
        message = f"no field {node.name!r} in `{base.text}` ({format_type(element)})"
        hint = self._scope.suggest_name(element, node.name)
        self._fail(message, node.name_span, hint, rule=_UNKNOWN_FIELD)
        return None

    def _infer_list(self, node: EachElement | Subscript) -> TypedExpression | None:
        base = self.infer(node.base)
        if base is not None and not is_list(base.type.arrow):
            self._fail(f"`{base.text}` is {format_type(base.type.element)}, not a list", node.span)
            return None
        return base

    def _each_element(self, node: EachElement) -> TypedExpression | None:
        base = self._infer_list(node)
        if base is None:
            return None
        return open_elements(base, self._source(node))

    def _subscript(self, node: Subscript) -> TypedExpression | None:
        base = self._infer_list(node)
        if base is None:
            return None
        element = expr_type_of(base.type.arrow.value_type, msgtype=base.type.msgtype)
        return ElementAt(base, node.index, replace(element, axes=base.type.axes), self._source(node))

    def _list(self, node: ListLiteral) -> TypedExpression | None:
        items = self._infer_all(node.items)
        if items is None:
            return None
        if not items:
            return MakeList((), ExprType(arrays.list_(arrays.null())), self._source(node))
        common = self._common_type(items, node)
        if common is None:
            return None
        element = narrowest_int(common.bounds) if common.bounds else common.arrow
        expr_type = ExprType(
            list_type(element, len(items)), axes=_deepest_axes(items), msgtype=common.msgtype
        )
        return MakeList(items, expr_type, self._source(node))

    def _infer_all(self, nodes: tuple[Node, ...]) -> tuple[TypedExpression, ...] | None:
        """Infer all nodes, so that the mistakes of each are reported; None if there was one."""
        typed = [self.infer(node) for node in nodes]
        valid = tuple(value for value in typed if value is not None)
        return valid if len(valid) == len(typed) else None

    def _common_type(self, values: tuple[TypedExpression, ...], node: Node) -> ExprType | None:
        try:
            return common_type([value.type.element for value in values])
        except TypeMismatch as mismatch:
            self._fail(str(mismatch), node.span, mismatch.hint)
            return None

    def _ternary(self, node: Ternary) -> TypedExpression | None:
        parts = self._infer_all((node.condition, node.then, node.otherwise))
        if parts is None:
            return None
        condition, then, otherwise = parts
        if not (pt.is_boolean(condition.type.arrow) or pt.is_null(condition.type.arrow)):
            message = (
                f"a condition must be a boolean, `{condition.text}` is {format_type(condition.type.element)}"
            )
            self._fail(message, node.condition.span, "compare it: x != 0")
            return None
        common = self._common_type((then, otherwise), node)
        if common is None:
            return None
        return Conditional(*parts, type=replace(common, axes=_deepest_axes(parts)), text=self._source(node))

    def _call(self, node: Call) -> TypedExpression | None:
        special_form = {"cast": self._cast, "either": self._either}.get(node.name)
        if special_form is not None:
            return special_form(node)
        function = lookup(node.name)
        arguments = self._arguments(node, function) if function is not None else None
        if function is None or arguments is None:
            return None  # `Analyzer` reports unknown functions before expressions are typed.
        names = self._argument_names(node) if function.named else ()
        if self._has_literal_problem(node, function, arguments) or names is None:
            return None
        if function.named:
            function = function.with_names(names)
        try:
            expr_type = check_call(function, [argument.type.element for argument in arguments])
        except TypeMismatch as mismatch:
            blamed = node if mismatch.argument is None else node.arguments[mismatch.argument]
            self._fail(str(mismatch), blamed.span, mismatch.hint)
            return None
        if pt.is_null(expr_type.arrow):
            return typed_constant(None, self._source(node))
        expr_type = replace(expr_type, axes=_deepest_axes(arguments))
        return FunctionCall(node.name, function, arguments, expr_type, self._source(node), names)

    def _has_literal_problem(
        self, node: Call, function: Function, arguments: tuple[TypedExpression, ...]
    ) -> bool:
        """Report an argument that must be a literal and is not, or is not a valid one."""
        for position, argument in enumerate(arguments):
            problem = _literal_problem(function.parameter(position), argument)
            if problem is not None:
                self._fail(f"{node.name} {problem}", node.arguments[position].span)
                return True
        if function.check_literals is not None:
            problem = function.check_literals(*arguments)
            if problem is not None:
                self._fail(f"{node.name}: {problem}", node.span)
                return True
        return False

    def _arguments(self, node: Call, function: Function) -> tuple[TypedExpression, ...] | None:
        """Infer the arguments of a call, with lists closed as the function takes them; None after a report."""
        if any(parameter.of_elements for parameter in function.parameter_types):
            arguments = self._infer_with_elements(node, function)
        else:
            arguments = self._infer_all(node.arguments)
        if arguments is None:
            return None
        return tuple(_close_for(function.parameter(i), argument) for i, argument in enumerate(arguments))

    def _infer_with_elements(self, node: Call, function: Function) -> tuple[TypedExpression, ...] | None:
        """Infer the arguments of a function with parameters that apply to each element of the first argument."""
        first = self.infer(node.arguments[0])
        if first is None:
            return None
        first = _close_for(function.parameter(0), first)
        arrow = first.type.arrow
        if not is_list(arrow):
            message = f"{node.name} takes {function.parameter(0).description} here, not {format_type(first.type.element)}"
            self._fail(message, node.arguments[0].span)
            return None
        elements = open_elements(first, f"{first.text}[]")
        inner = Checker(self._scope.of_elements(elements), self._report, self._text)
        arguments: list[TypedExpression | None] = [first]
        for position, argument in enumerate(node.arguments[1:], 1):
            if not function.parameter(position).of_elements:
                arguments.append(self.infer(argument))
                continue
            typed = inner.infer(argument)
            arguments.append(typed)
            if typed is not None and len(typed.type.axes) != len(elements.type.axes):
                fewer = len(typed.type.axes) < len(elements.type.axes)
                problem = "does not refer to the elements" if fewer else "has several values for each element"
                hint = (
                    "name a field of the elements; `self` is the element"
                    if fewer
                    else "reduce it to one value"
                )
                self._fail(f"`{typed.text}` {problem} of `{first.text}`", argument.span, hint)
                return None
        valid = tuple(value for value in arguments if value is not None)
        return valid if len(valid) == len(arguments) else None

    def _argument_names(self, node: Call) -> tuple[str, ...] | None:
        """Return the name of each argument, such as `y` for `x.y[]`; None after a report."""
        names: list[str] = []
        for argument in node.arguments:
            base: Node = argument
            while isinstance(base, (EachElement, Subscript)):
                base = base.base
            if not isinstance(base, (Name, Attribute)) or base.name in names:
                problem = (
                    "has no name" if not isinstance(base, (Name, Attribute)) else f"is another {base.name!r}"
                )
                message = f"{node.name} names its fields after its arguments, and `{self._source(argument)}` {problem}"
                self._fail(message, argument.span, "bind the argument to a name with `let`")
                return None
            names.append(base.name)
        return tuple(names)

    def _cast(self, node: Call) -> TypedExpression | None:
        if len(node.arguments) != 2:  # noqa: PLR2004 - value and type
            hint = f"use one of {', '.join(CAST_TYPES)}"
            self._fail("inside an expression, cast(x, 'type') needs the type", node.span, hint)
            return None
        operand = self.infer(node.arguments[0])
        target = node.arguments[1]
        type_ = CAST_TYPES.get(str(target.value)) if isinstance(target, Literal) else None
        if type_ is None:
            message = f"cast converts to {', '.join(CAST_TYPES)}"
            self._fail(message, target.span, "write one of these types in quotes")
            return None
        return None if operand is None else self.cast(operand, type_, node)

    def _either(self, node: Call) -> TypedExpression | None:
        """Return the first argument whose fields exist; if none does, report the mistake of the last."""
        for argument in node.arguments[:-1]:
            rules: list[str] = []
            silent = Checker(self._scope, _collect_rules(rules), self._text)
            typed = silent.infer(argument)
            if typed is not None:
                return typed
            if set(rules) != {_UNKNOWN_FIELD}:
                return self.infer(argument)  # for the report
        return self.infer(node.arguments[-1])


def open_elements(operand: TypedExpression, text: str) -> OpenList:
    """Return the elements of an expression that is a list."""
    arrow = operand.type.arrow
    size = arrow.list_size if pt.is_fixed_size_list(arrow) else None
    element = expr_type_of(arrow.value_type, msgtype=operand.type.msgtype)
    return OpenList(operand, replace(element, axes=(*operand.type.axes, size)), text)


def _resolve(scope: Scope, name: str) -> TypedExpression | None:
    """Return the value of a name: of a binding, a field, a constant, or else in the enclosing scope."""
    bound = scope.bound(name)
    if bound is not None:
        return bound
    subject = scope.subject or MessageRef(scope.message)
    field = scope.field(scope.message, name)
    if field is not None:
        return FieldAccess(subject, name, field, name)
    if name == "self":
        return subject
    value = scope.constants(scope.message).get(name)
    if value is not None:
        return typed_constant(value, name)
    if scope.enclosing is not None:
        return _resolve(scope.enclosing, name)
    number = _NUMBERS.get(name)
    return None if number is None else typed_constant(number, name)


def _collect_rules(rules: list[str]) -> Report:
    """Return a report that only collects the rule ids."""

    def report(rule: str, message: str, span: TextRange, hint: str | None) -> None:  # noqa: ARG001 - the protocol's
        rules.append(rule)

    return report


def _literal_problem(parameter: Parameter, argument: TypedExpression) -> str | None:
    """Return the problem of an argument whose parameter takes a literal, None if it is valid."""
    if not parameter.literal:
        return None
    if not isinstance(argument, Constant) or not isinstance(argument.value, str):
        return f"takes {parameter.description} here"
    problem = parameter.check_literal(argument.value) if parameter.check_literal else None
    return f"does not accept this text: {problem}" if problem else None


def _close_for(parameter: Parameter, argument: TypedExpression) -> TypedExpression:
    """Close the innermost open list if the function takes the list instead of its elements."""
    if not argument.type.axes or parameter.takes(argument.type.element):
        return argument
    closed = argument.type.close_innermost()
    return CloseList(argument, closed, argument.text) if parameter.takes(closed.element) else argument


def _deepest_axes(values: tuple[TypedExpression, ...]) -> tuple[int | None, ...]:
    """Return the open lists of the most deeply nested value."""
    return max((value.type.axes for value in values), key=len, default=())


_Result = TypeVar("_Result")

_SPECIAL_FORMS = {
    "cast": (1, 2, "cast(x) or cast(x, 'int32')"),
    "either": (2, 99, "either(a, b, …)"),
    "if_else": (3, 3, "if_else(condition, then, otherwise)"),
}
"""Calls that are not functions over columns: minimum and maximum number of arguments, signature."""


class Target(Struct, frozen=True):
    """A column to fill: its type, the location of its value in the file, and the scope of the names in that value."""

    name: str
    """The column's path, such as `pose.position`; empty for the record."""
    type: DataType
    path: KeyPath
    scope: Scope | None
    """None if no message definition is known."""
    title: str
    """The column's name in messages."""

    def at(self, *keys: str) -> Target:
        """Return the target with the key path extended."""
        return replace(self, path=(*self.path, *keys))

    def inside(self, name: str) -> str:
        """Return the path of a field of this column."""
        return f"{self.name}.{name}" if self.name else name


class Analyzer:
    """Analyzes the expressions of one file; `findings` collects the mistakes."""

    def __init__(self, source: Callable[[], Source]) -> None:
        self.findings: list[Finding] = []
        self._source = source

    def report(
        self, path: KeyPath, message: str, hint: str | None = None, *, rule: str = "adapter-file"
    ) -> None:
        """Report a mistake, located at the key that `path` ends with."""
        self._add(Finding(rule, Severity.ERROR, message, self._source().key_span(path), hint))

    def report_value(
        self, path: KeyPath, message: str, hint: str | None = None, *, rule: str = "adapter-file"
    ) -> None:
        """Report a mistake, located at the value of `path`."""
        self._add(Finding(rule, Severity.ERROR, message, self._source().span(path), hint))

    def report_inside(
        self, path: KeyPath, span: TextRange, rule: str, message: str, hint: str | None
    ) -> None:
        """Report a mistake in a part of an expression."""
        location = self._source().inner_span(path, *span)
        self._add(Finding(rule, Severity.ERROR, message, location, hint))

    def report_mismatch(self, value: AnalyzedExpression | KeyPath, mismatch: TypeMismatch) -> None:
        """Report that a value does not fit its column."""
        if isinstance(value, AnalyzedExpression):
            self.report_inside(value.path, value.node.span, "type-mismatch", str(mismatch), mismatch.hint)
        else:
            self.report_value(value, str(mismatch), mismatch.hint, rule="type-mismatch")

    def _add(self, finding: Finding) -> None:
        if finding not in self.findings:
            self.findings.append(finding)

    def check_fits(self, value: AnalyzedExpression | KeyPath, expr_type: ExprType, target: DataType) -> bool:
        """Return whether every value of a type fits a column; report it otherwise."""

        def check() -> bool:
            check_fits(expr_type, target)
            return True

        return self._attempt(value, check) is not None

    def element_type(
        self, value: AnalyzedExpression | KeyPath, expr_type: ExprType, target: DataType
    ) -> DataType | None:
        """Return the type that the elements of open lists must have for a column; None after a finding."""
        return self._attempt(value, lambda: element_type(target, expr_type.axes))

    def _attempt(self, value: AnalyzedExpression | KeyPath, run: Callable[[], _Result]) -> _Result | None:
        try:
            return run()
        except TypeMismatch as mismatch:
            self.report_mismatch(value, mismatch)
            return None

    def expression(self, path: KeyPath, text: str, scope: Scope | None) -> AnalyzedExpression | None:
        """Parse an expression and, with a scope, type it; None after a finding."""
        try:
            node = parse(text)
        except ExpressionError as error:
            self.report_inside(path, error.span, "expression-syntax", str(error), error.hint)
            return None
        count = len(self.findings)
        self._check_calls(path, node)
        if len(self.findings) > count:
            return None
        if scope is None:
            return AnalyzedExpression(path, text, node, None)
        typed = self._checker(path, text, scope).infer(_without_cast(node))
        return None if typed is None else AnalyzedExpression(path, text, node, typed)

    def scalar(
        self, path: KeyPath, value: Scalar, scope: Scope | None
    ) -> AnalyzedExpression | Constant | None:
        """Analyze a plain value: text is an expression, anything else a literal."""
        if isinstance(value, str):
            return self.expression(path, value, scope)
        return typed_constant(value, str(value))

    def cast(self, expression: AnalyzedExpression, target: Target) -> TypedExpression | None:
        """Return x of `cast(x)` as the type of the target; None after a finding."""
        if expression.typed is None or target.scope is None:
            return None
        element = self.element_type(expression, expression.typed.type, target.type)
        if element is None:
            return None
        if pt.is_nested(element) or pt.is_string(element) or pt.is_binary(element):
            message = f"cast converts to numbers and booleans, the column is {format_type(element)}"
            self.report_inside(expression.path, expression.node.span, "type-mismatch", message, None)
            return None
        checker = self._checker(expression.path, expression.text, target.scope)
        return checker.cast(expression.typed, element, expression.node)

    def nested_scope(self, of: AnalyzedExpression | None, scope: Scope | None) -> Scope | None:
        """Return the scope of the message that `of` selects, or the outer scope without `of`; None after a finding."""
        if of is None or scope is None:
            return scope
        if of.typed is None:
            return None
        element = of.typed.type.element
        if pt.is_struct(element.arrow):
            return scope.nested(element)
        hint = f"write {of.typed.text}[]" if is_list(element.arrow) else None
        message = f"`{of.typed.text}` is {format_type(element)}, not a message"
        self.report_inside(of.path, of.node.span, "operand-type", message, hint)
        return None

    def _checker(self, path: KeyPath, text: str, scope: Scope) -> Checker:
        def report(rule: str, message: str, span: TextRange, hint: str | None) -> None:
            self.report_inside(path, span, rule, message, hint)

        return Checker(scope, report, text)

    def _check_calls(self, path: KeyPath, node: Node) -> None:
        """Report calls of unknown functions and with a wrong number of arguments; this needs no scope."""
        if isinstance(node, Call):
            self._check_call(path, node)
        for child in children(node):
            self._check_calls(path, child)

    def _check_call(self, path: KeyPath, node: Call) -> None:
        if node.name in _SPECIAL_FORMS:
            minimum, maximum, signature = _SPECIAL_FORMS[node.name]
            if not minimum <= len(node.arguments) <= maximum:
                self.report_inside(path, node.span, "function-arguments", f"write {signature}", None)
            return
        function = lookup(node.name)
        if function is None:
            names = [*(entry.name for entry in functions()), *_SPECIAL_FORMS]
            hint = suggest_synonym(node.name) or suggest(node.name, names)
            message = f"there is no function {node.name!r}"
            self.report_inside(path, node.name_span, "unknown-function", message, hint)
        elif problem := function.arity_problem(len(node.arguments)):
            hint = suggest_synonym(f"list_{node.name}") if len(node.arguments) == 1 else None
            self.report_inside(path, node.span, "function-arguments", problem, hint)


def is_short_cast(node: Node) -> bool:
    """Return whether an expression is `cast(x)`, which converts to the type of its column."""
    return isinstance(node, Call) and node.name == "cast" and len(node.arguments) == 1


def _without_cast(node: Node) -> Node:
    """Return x of `cast(x)`, any other expression as it is."""
    return node.arguments[0] if isinstance(node, Call) and is_short_cast(node) else node
