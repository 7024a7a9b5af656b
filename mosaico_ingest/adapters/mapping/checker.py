"""Resolve the names and types of expressions, and report findings with their location."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.conversion import demand, peel
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import Take, check, nearest
from mosaico_ingest.adapters.mapping.model import Scalar
from mosaico_ingest.adapters.mapping.parser import (
    Attribute,
    Call,
    Choice,
    Each,
    ExpressionError,
    Item,
    ListOf,
    Literal,
    LiteralValue,
    Name,
    Node,
    Place,
    children,
    parse,
)
from mosaico_ingest.adapters.mapping.typed import (
    Apply,
    Cast,
    ChoiceOf,
    Const,
    EachOf,
    FieldOf,
    Fold,
    ItemOf,
    ListValue,
    Typed,
    Whole,
    Written,
)
from mosaico_ingest.adapters.mapping.types import (
    Kind,
    Unfit,
    is_list,
    is_number,
    join,
    kind_of,
    listed,
    narrowest_int,
    spell,
)
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.rosbag.definitions.model import MessageType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath, Source

__all__ = [
    "CAST_TYPES",
    "SPECIAL",
    "Analyzer",
    "Checker",
    "Report",
    "Scope",
    "Slot",
    "constant",
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

Report = Callable[[str, str, Place, "str | None"], None]
"""Takes a mistake: its rule, what, where in the expression, what to do."""
_UNKNOWN, _TYPE = "unknown-field", "operand-type"


class Scope(Struct, frozen=True):
    """Where names are looked up: a message and the types it is made of."""

    kind: Kind
    types: Mapping[str, MessageType]

    def field(self, kind: Kind, name: str) -> Kind | None:
        """Return the kind of a field of a message."""
        position = kind.type.get_field_index(name)
        if position < 0:
            return None
        known = self.types.get(kind.msgtype or "")
        declared = next((field for field in known.fields if field.name == name), None) if known else None
        msgtype = declared.type if declared is not None and declared.is_message else None
        return replace(kind_of(kind.type.field(position).type, msgtype=msgtype), axes=kind.axes)

    def constant(self, kind: Kind, name: str) -> LiteralValue:
        """Return a constant of a message's type."""
        known = self.types.get(kind.msgtype or "")
        return next((c.value for c in known.constants if c.name == name), None) if known else None

    def names(self, kind: Kind) -> list[str]:
        """Return the fields of a message."""
        return [field.name for field in kind.type]

    def describe(self, kind: Kind, name: str) -> str:
        """Return the sentence for a field that is not there."""
        names = self.names(kind)
        near = nearest(name, names)
        listing = f"it has {', '.join(names)}" if names else "it has no fields"
        return f"{near} {listing}" if near else listing


def constant(value: LiteralValue, text: str = "") -> Const:
    """Return a literal as a typed value."""
    if value is None:
        return Const(value, Kind(arrays.null()), text)
    if isinstance(value, bool):
        return Const(value, Kind(arrays.bool_()), text)
    if isinstance(value, int):
        type_ = arrays.int64() if value < 2**63 else arrays.uint64()
        return Const(value, Kind(type_, bounds=(value, value)), text)
    if isinstance(value, float):
        return Const(value, Kind(arrays.float16()), text)  # its precision is what it meets
    return Const(value, Kind(arrays.string()), text)


class Checker:
    """Types the expressions of one scope; a mistake is reported once and poisons what is built on it."""

    def __init__(self, scope: Scope, report: Report, text: str) -> None:
        self._scope = scope
        self._report = report
        self._text = text
        self._readers: dict[type[Any], Callable[[Any], Typed | None]] = {
            Literal: lambda node: constant(node.value, self._source(node)),
            Name: self._name,
            Attribute: self._attribute,
            Each: self._each,
            Item: self._item,
            ListOf: self._list,
            Choice: self._choice,
            Call: self._call,
        }

    def infer(self, node: Node) -> Typed | None:
        """Return the typed expression, or None after a report."""
        return self._readers[type(node)](node)

    def _fail(self, message: str, place: Place, hint: str | None = None, *, rule: str = _TYPE) -> None:
        self._report(rule, message, place, hint)

    def _source(self, node: Node) -> str:
        return self._text[node.at[0] : node.at[1]]

    def _name(self, node: Name) -> Typed | None:
        scope = self._scope
        field = scope.field(scope.kind, node.name)
        if node.name == "self" and field is None:
            return Whole(scope.kind)
        if field is not None:
            return FieldOf(Whole(scope.kind), node.name, field, node.name)
        value = scope.constant(scope.kind, node.name)
        value = _NUMBERS.get(node.name) if value is None else value
        if value is not None:
            return constant(value, node.name)
        what = f"no field {node.name!r} in {spell(scope.kind)}"
        self._fail(what, node.at, scope.describe(scope.kind, node.name), rule=_UNKNOWN)
        return None

    def _attribute(self, node: Attribute) -> Typed | None:
        of = self.infer(node.of)
        if of is None:
            return None
        element = of.kind.element
        if not pt.is_struct(element.type):
            hint = f"write {of.text}[].{node.name}" if is_list(element.type) else None
            self._fail(f"`{of.text}` is {spell(element)}, it has no fields", node.name_at, hint)
            return None
        field = self._scope.field(of.kind, node.name)
        if field is not None:
            return FieldOf(of, node.name, field, self._source(node))
        value = self._scope.constant(element, node.name)
        if value is not None:
            return constant(value, self._source(node))
        what = f"no field {node.name!r} in `{of.text}` ({spell(element)})"
        self._fail(what, node.name_at, self._scope.describe(element, node.name), rule=_UNKNOWN)
        return None

    def _listed(self, node: Each | Item) -> Typed | None:
        of = self.infer(node.of)
        if of is not None and not is_list(of.kind.type):
            self._fail(f"`{of.text}` is {spell(of.kind.element)}, not a list", node.at)
            return None
        return of

    def _each(self, node: Each) -> Typed | None:
        of = self._listed(node)
        if of is None:
            return None
        type_ = of.kind.type
        size = type_.list_size if pt.is_fixed_size_list(type_) else None
        kind = kind_of(type_.value_type, msgtype=of.kind.msgtype)
        return EachOf(of, replace(kind, axes=(*of.kind.axes, size)), self._source(node))

    def _item(self, node: Item) -> Typed | None:
        of = self._listed(node)
        if of is None:
            return None
        kind = kind_of(of.kind.type.value_type, msgtype=of.kind.msgtype)
        return ItemOf(of, node.index, replace(kind, axes=of.kind.axes), self._source(node))

    def _list(self, node: ListOf) -> Typed | None:
        items = self._all(node.items)
        if items is None:
            return None
        if not items:
            return ListValue((), Kind(arrays.list_(arrays.null())), self._source(node))
        joined = self._joined(items, node)
        if joined is None:
            return None
        element = narrowest_int(joined.bounds) if joined.bounds else joined.type
        kind = Kind(listed(element, len(items)), axes=_deepest(items), msgtype=joined.msgtype)
        return ListValue(items, kind, self._source(node))

    def _all(self, nodes: tuple[Node, ...]) -> tuple[Typed, ...] | None:
        """Infer all, so that each mistake is reported; None if there was one."""
        typed = [self.infer(node) for node in nodes]
        good = tuple(value for value in typed if value is not None)
        return good if len(good) == len(typed) else None

    def _joined(self, values: tuple[Typed, ...], node: Node) -> Kind | None:
        try:
            return join([value.kind.element for value in values])
        except Unfit as unfit:
            self._fail(str(unfit), node.at, unfit.hint)
            return None

    def _choice(self, node: Choice) -> Typed | None:
        parts = self._all((node.condition, node.then, node.otherwise))
        if parts is None:
            return None
        condition, then, otherwise = parts
        if not (pt.is_boolean(condition.kind.type) or pt.is_null(condition.kind.type)):
            what = f"a condition is true or false, `{condition.text}` is {spell(condition.kind.element)}"
            self._fail(what, node.condition.at, "compare it: x != 0")
            return None
        joined = self._joined((then, otherwise), node)
        if joined is None:
            return None
        return ChoiceOf(*parts, kind=replace(joined, axes=_deepest(parts)), text=self._source(node))

    def _cast(self, node: Call) -> Typed | None:
        if len(node.arguments) != 2:  # noqa: PLR2004 - value and type
            self._fail(
                "inside an expression cast(x, 'type') needs the type",
                node.at,
                f"one of {', '.join(CAST_TYPES)}",
            )
            return None
        of = self.infer(node.arguments[0])
        wanted = node.arguments[1]
        type_ = CAST_TYPES.get(str(wanted.value)) if isinstance(wanted, Literal) else None
        if type_ is None:
            self._fail("cast makes " + ", ".join(CAST_TYPES), wanted.at, "write the type in quotes")
            return None
        return None if of is None else self.cast(of, type_, node)

    def cast(self, of: Typed, type_: Any, node: Node) -> Typed | None:  # noqa: ANN401 - an Arrow type
        """Return a value as another number type, checked for each row."""
        element = of.kind.type
        if not (is_number(element) or pt.is_boolean(element) or pt.is_null(element)):
            self._fail(
                f"cast takes a number, `{of.text}` is {spell(of.kind.element)}",
                node.at,
                "number(x) reads text",
            )
            return None
        return Cast(of, type_, replace(kind_of(type_), axes=of.kind.axes), self._source(node))

    def _either(self, node: Call) -> Typed | None:
        """Take the first argument whose fields exist; where none does, the last says what is there."""
        for argument in node.arguments[:-1]:
            mistakes: list[str] = []
            quiet = Checker(self._scope, _noting(mistakes), self._text)
            typed = quiet.infer(argument)
            if typed is not None or set(mistakes) != {_UNKNOWN}:
                return typed or self.infer(argument)
        return self.infer(node.arguments[-1])

    def _call(self, node: Call) -> Typed | None:
        if node.name in {"cast", "either"}:
            return self._cast(node) if node.name == "cast" else self._either(node)
        function = lookup(node.name)
        arguments = self._all(node.arguments)
        if function is None or arguments is None:
            return None  # an unknown function was reported when the file was read
        arguments = tuple(_folded(a, function.take(i).takes) for i, a in enumerate(arguments))
        for position, argument in enumerate(arguments):
            problem = _literal_problem(function.take(position), argument)
            if problem is not None:
                self._fail(f"{node.name} {problem}", node.arguments[position].at)
                return None
        try:
            kind = check(function, [argument.kind.element for argument in arguments])
        except Unfit as unfit:
            blamed = node if unfit.argument is None else node.arguments[unfit.argument]
            self._fail(str(unfit), blamed.at, unfit.hint)
            return None
        if pt.is_null(kind.type):
            return constant(None, self._source(node))
        kind = replace(kind, axes=_deepest(arguments))
        return Apply(node.name, function, arguments, kind, self._source(node))


def _noting(rules: list[str]) -> Report:
    """Return a report that only keeps the rules that were broken."""

    def note(rule: str, message: str, place: Place, hint: str | None) -> None:  # noqa: ARG001 - a report's arguments
        rules.append(rule)

    return note


def _literal_problem(take: Take, argument: Typed) -> str | None:
    """Return what is wrong with an argument that has to be written out."""
    if not take.literal:
        return None
    if not isinstance(argument, Const) or not isinstance(argument.value, str):
        return f"takes {take.words} here"
    problem = take.problem(argument.value) if take.problem else None
    return f"cannot take this: {problem}" if problem else None


def _folded(value: Typed, takes: Callable[[Kind], bool]) -> Typed:
    """Close the innermost open list if the function takes the list, not its elements."""
    if not value.kind.axes or takes(value.kind.element):
        return value
    folded = value.kind.folded()
    return Fold(value, folded, value.text) if takes(folded.element) else value


def _deepest(values: tuple[Typed, ...]) -> tuple[int | None, ...]:
    """Return the open lists of the value that has most."""
    return max((value.kind.axes for value in values), key=len, default=())


SPECIAL = {
    "cast": (1, 2, "cast(x) or cast(x, 'int32')"),
    "either": (2, 99, "either(a, b, …)"),
    "if_else": (3, 3, "if_else(condition, then, otherwise)"),
}
"""What looks like a function and is not: fewest and most arguments, spelling."""


class Slot(Struct, frozen=True):
    """A column to be filled: what it must be, where the file says so, and where names are read."""

    name: str
    """With those around it, as `pose.position`; empty for the record."""
    type: DataType
    path: KeyPath
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

    def report(
        self, path: KeyPath, message: str, help_: str | None = None, *, rule: str = "adapter-file"
    ) -> None:
        """Note a mistake about a key or value."""
        self.findings.append(Finding(rule, Severity.ERROR, message, self._source().key_span(path), help_))

    def report_inside(self, path: KeyPath, place: Place, rule: str, message: str, help_: str | None) -> None:
        """Note a mistake in a part of an expression."""
        span = self._source().inner_span(path, *place)
        self.findings.append(Finding(rule, Severity.ERROR, message, span, help_))

    def misfit(self, at: Written | KeyPath, unfit: Unfit) -> None:
        """Note that a value does not fit."""
        if isinstance(at, Written):
            self.report_inside(at.path, at.node.at, "type-mismatch", str(unfit), unfit.hint)
        else:
            span = self._source().span(at)
            self.findings.append(Finding("type-mismatch", Severity.ERROR, str(unfit), span, unfit.hint))

    def demand(self, at: Written | KeyPath, kind: Kind, target: DataType) -> bool:
        """Check that values fit a column; otherwise note it."""
        return self.tried(at, lambda: (demand(kind, target), True)[1]) is not None

    def peeled(self, at: Written | KeyPath, kind: Kind, target: DataType) -> DataType | None:
        """Return what an element of open lists must be; None after a finding."""
        return self.tried(at, lambda: peel(target, kind.axes))

    def tried(self, at: Written | KeyPath, run: Callable[[], Any]) -> Any:  # noqa: ANN401 - what run returns
        """Return the result of a check, or None after a finding."""
        try:
            return run()
        except Unfit as unfit:
            self.misfit(at, unfit)
            return None

    def expression(self, path: KeyPath, text: str, scope: Scope | None) -> Written | None:
        """Read and type an expression; None after a finding."""
        try:
            node = parse(text)
        except ExpressionError as error:
            self.report_inside(path, error.place, "expression-syntax", str(error), error.hint)
            return None
        known = len(self.findings)
        self._check_calls(path, node)
        if len(self.findings) > known:
            return None
        if scope is None:
            return Written(path, text, node, None)
        typed = self.checker(path, text, scope).infer(without_cast(node))
        return None if typed is None else Written(path, text, node, typed)

    def scalar(self, path: KeyPath, value: Scalar, scope: Scope | None) -> Written | Const | None:
        """Compile a plain value: text is an expression, anything else itself."""
        return self.expression(path, value, scope) if isinstance(value, str) else constant(value, str(value))

    def checker(self, path: KeyPath, text: str, scope: Scope) -> Checker:
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
            self.report_inside(written.path, written.node.at, "type-mismatch", message, None)
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
        self.report_inside(of.path, of.node.at, "operand-type", message, hint)
        return None

    def _check_calls(self, path: KeyPath, node: Node) -> None:
        if isinstance(node, Call):
            self._check_call(path, node)
        for child in children(node):
            self._check_calls(path, child)

    def _check_call(self, path: KeyPath, node: Call) -> None:
        if node.name in SPECIAL:
            fewest, most, spelling = SPECIAL[node.name]
            if not fewest <= len(node.arguments) <= most:
                message = f"it is written {spelling}"
                self.report_inside(path, node.at, "function-arguments", message, None)
            return
        function = lookup(node.name)
        if function is None:
            near = nearest(node.name, [*(known.name for known in functions()), *SPECIAL])
            message = f"there is no function {node.name!r}"
            self.report_inside(path, node.name_at, "unknown-function", message, near)
        elif problem := function.arity_problem(len(node.arguments)):
            self.report_inside(path, node.at, "function-arguments", problem, None)


def is_short_cast(node: Node) -> bool:
    """Return whether an expression is `cast(x)`, to the type of what it fills."""
    return isinstance(node, Call) and node.name == "cast" and len(node.arguments) == 1


def without_cast(node: Node) -> Node:
    """Return x of `cast(x)`, any other expression as it is."""
    return node.arguments[0] if isinstance(node, Call) and is_short_cast(node) else node
