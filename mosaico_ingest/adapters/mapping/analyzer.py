"""Parse and type-check the expressions of one adapter file, and collect the findings with their location."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.checker import Checker, Scope, typed_constant
from mosaico_ingest.adapters.mapping.columns import DataType, pt
from mosaico_ingest.adapters.mapping.conversion import check_fits, element_type
from mosaico_ingest.adapters.mapping.expressions import AnalyzedExpression, Constant, TypedExpression
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import suggest, suggest_synonym
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.adapters.mapping.parser import Call, ExpressionError, Node, TextRange, children, parse
from mosaico_ingest.adapters.mapping.types import ExprType, TypeMismatch, format_type, is_list
from mosaico_ingest.findings import Finding, Severity

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath, Source

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
