"""This file reads and types the expressions of an adapter file, and reports every mistake at its place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mosaico_ingest.adapters.mapping.arrow import DataType, pt
from mosaico_ingest.adapters.mapping.check import Checker, Scope, constant
from mosaico_ingest.adapters.mapping.expression import Call, ExpressionError, Node, Place, children, parse
from mosaico_ingest.adapters.mapping.fit import demand, peel
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import nearest
from mosaico_ingest.adapters.mapping.kinds import Kind, Unfit, is_list, spell
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.adapters.mapping.typed import Const, Typed, Written
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.frozen import frozen

if TYPE_CHECKING:
    from mosaico_ingest.manifest.source import Path, Source

__all__ = ["SPECIAL", "Analyzer", "Slot"]

SPECIAL = {
    "cast": (1, 2, "cast(x) or cast(x, 'int32')"),
    "either": (2, 99, "either(a, b, …)"),
    "if_else": (3, 3, "if_else(condition, then, otherwise)"),
}
"""What looks like a function and is not: fewest and most arguments, spelling."""


@frozen
class Slot:
    """A column to be filled: what it must be, where the file says so, and where names are read."""

    name: str
    """With those around it, as `pose.position`; empty for the record."""
    type: DataType
    path: Path
    scope: Scope | None
    """None while there is no message to look at."""
    title: str
    """What messages call it."""

    def at(self, *keys: str) -> Slot:
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

    def report(self, path: Path, message: str, help_: str | None = None, *, rule: str = "mapping") -> None:
        """Note a mistake about a key or value."""
        self.findings.append(Finding(rule, Severity.ERROR, message, self._source().key_span(path), help_))

    def report_inside(self, path: Path, place: Place, rule: str, message: str, help_: str | None) -> None:
        """Note a mistake in a part of an expression."""
        span = self._source().inner_span(path, *place)
        self.findings.append(Finding(rule, Severity.ERROR, message, span, help_))

    def misfit(self, at: Written | Path, unfit: Unfit) -> None:
        """Note that a value does not fit."""
        if isinstance(at, Written):
            self.report_inside(at.path, at.node.at, "misfit", str(unfit), unfit.hint)
        else:
            span = self._source().span(at)
            self.findings.append(Finding("misfit", Severity.ERROR, str(unfit), span, unfit.hint))

    def demand(self, at: Written | Path, kind: Kind, target: DataType) -> bool:
        """Check that values fit a column; otherwise note it."""
        return self.tried(at, lambda: (demand(kind, target), True)[1]) is not None

    def peeled(self, at: Written | Path, kind: Kind, target: DataType) -> DataType | None:
        """Return what an element of open lists must be; None after a finding."""
        return self.tried(at, lambda: peel(target, kind.axes))

    def tried(self, at: Written | Path, run: Callable[[], Any]) -> Any:  # noqa: ANN401 - what run returns
        """Return the result of a check, or None after a finding."""
        try:
            return run()
        except Unfit as unfit:
            self.misfit(at, unfit)
            return None

    def expression(self, path: Path, text: str, scope: Scope | None) -> Written | None:
        """Read and type an expression; None after a finding."""
        try:
            node = parse(text)
        except ExpressionError as error:
            self.report_inside(path, error.place, "expression", str(error), error.hint)
            return None
        known = len(self.findings)
        self._check_calls(path, node)
        if len(self.findings) > known:
            return None
        if scope is None:
            return Written(path, text, node, None)
        typed = self.checker(path, text, scope).infer(without_cast(node))
        return None if typed is None else Written(path, text, node, typed)

    def scalar(self, path: Path, value: Scalar, scope: Scope | None) -> Written | Const | None:
        """Compile a plain value: text is an expression, anything else itself."""
        return self.expression(path, value, scope) if isinstance(value, str) else constant(value, str(value))

    def checker(self, path: Path, text: str, scope: Scope) -> Checker:
        """Return what types expressions at a path."""

        def report(rule: str, message: str, place: Place, help_: str | None) -> None:
            self.report_inside(path, place, rule, message, help_)

        return Checker(scope, report, text)

    def cast(self, written: Written, slot: Slot) -> Typed | None:
        """Apply `cast(x)`: to whatever number the column is."""
        if written.typed is None or slot.scope is None:
            return None
        element = self.peeled(written, written.typed.kind, slot.type)
        if element is None:
            return None
        if pt.is_nested(element) or pt.is_string(element) or pt.is_binary(element):
            message = f"cast makes numbers and booleans, the target is {spell(element)}"
            self.report_inside(written.path, written.node.at, "misfit", message, None)
            return None
        checker = self.checker(written.path, written.text, slot.scope)
        return checker.cast(written.typed, element, written.node)

    def inside(self, of: Written | None, scope: Scope | None) -> Scope | None:
        """Return the scope of the message that `of` gives; the outer one where nothing is said."""
        if of is None or scope is None:
            return scope
        if of.typed is None:
            return None
        element = of.typed.kind.element
        if pt.is_struct(element.type):
            return replace(scope, kind=element)
        hint = f"write {of.typed.text}[]" if is_list(element.type) else None
        message = f"`{of.typed.text}` is {spell(element)}, not a message"
        self.report_inside(of.path, of.node.at, "type", message, hint)
        return None

    def _check_calls(self, path: Path, node: Node) -> None:
        if isinstance(node, Call):
            self._check_call(path, node)
        for child in children(node):
            self._check_calls(path, child)

    def _check_call(self, path: Path, node: Call) -> None:
        if node.name in SPECIAL:
            fewest, most, spelling = SPECIAL[node.name]
            if not fewest <= len(node.arguments) <= most:
                message = f"it is written {spelling}"
                self.report_inside(path, node.at, "arguments", message, None)
            return
        function = lookup(node.name)
        if function is None:
            near = nearest(node.name, [*(known.name for known in functions()), *SPECIAL])
            message = f"there is no function {node.name!r}"
            self.report_inside(path, node.name_at, "unknown-function", message, near)
        elif problem := function.arity_problem(len(node.arguments)):
            self.report_inside(path, node.at, "arguments", problem, None)


def is_short_cast(node: Node) -> bool:
    """Return whether an expression is `cast(x)`, to the type of what it fills."""
    return isinstance(node, Call) and node.name == "cast" and len(node.arguments) == 1


def without_cast(node: Node) -> Node:
    """Return x of `cast(x)`, any other expression as it is."""
    return node.arguments[0] if isinstance(node, Call) and is_short_cast(node) else node
