"""This file compiles an adapter file: every mistake becomes a finding at its place, what is right becomes a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeAlias

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.mapping.arrow import DataType, pt
from mosaico_ingest.adapters.mapping.build import Absent, ByAdapter, ByFields, Computed, Filled, Source
from mosaico_ingest.adapters.mapping.check import Checker, Scope, constant
from mosaico_ingest.adapters.mapping.expression import Call, ExpressionError, Node, Place, children, parse
from mosaico_ingest.adapters.mapping.fit import demand, peel
from mosaico_ingest.adapters.mapping.functions import functions, lookup
from mosaico_ingest.adapters.mapping.functions.registry import nearest
from mosaico_ingest.adapters.mapping.kinds import Kind, Unfit, kind_of, spell
from mosaico_ingest.adapters.mapping.lookup_table import compile_lookup
from mosaico_ingest.adapters.mapping.model import Form, MappingFile, Scalar, Value
from mosaico_ingest.adapters.mapping.typed import Const, Typed, Written
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.manifest.source import Path
from mosaico_ingest.manifest.source import Source as Text
from mosaico_ingest.ontology.types import OntologyType

__all__ = ["AdapterLookup", "Compiler"]

AdapterLookup: TypeAlias = Callable[[str], "AdapterSpec | None"]


class Compiler:
    """Compiles one file; with a definition for one message type, without it as far as one can see."""

    def __init__(self, text: Text, definition: Definition | None, adapters: AdapterLookup | None) -> None:
        self.findings: list[Finding] = []
        self._text = text
        self._definition = definition
        self._adapters = adapters

    def record(
        self, model: MappingFile, ontology: OntologyType, scope: Scope | None, variant: str | None
    ) -> Filled | None:
        """Compile the whole record; None where a mistake or no scope leaves nothing to run."""
        wraps = {variant: model.variants[variant]} if model.variants and variant else model.variants or {}
        compiled: Filled | None = None
        for name, wrap in wraps.items() if wraps else [(None, None)]:
            compiled = self._record(model, ontology, scope, ("variants", name), dict(wrap or {}))
        return compiled

    def _record(
        self,
        model: MappingFile,
        ontology: OntologyType,
        scope: Scope | None,
        at: Path,
        wrap: dict[str, Value],
    ) -> Filled | None:
        of = self._optional_text((*at, "of"), wrap.pop("of", None), scope)
        inner, spelled = self._inside(of, scope), f"ontology {ontology.tag}"
        replaced = self._targets(wrap, at, ontology.struct, scope, spelled)
        seen = len(self.findings)
        fields = self._targets(model.fields, ("fields",), ontology.struct, inner, spelled, skip=set(wrap))
        if at[1] is not None and model.variants and next(iter(model.variants)) != at[1] and scope is None:
            del self.findings[seen:]  # the same fields were looked at with the first variant
        self._require(ontology.struct, {*model.fields, *wrap}, ("fields",), spelled)
        if scope is None or fields is None or replaced is None or (of is not None and of.typed is None):
            return None
        source = ByFields(of.typed if of else None, _complete(fields, ontology.struct))
        return Filled(
            ontology.tag, ontology.tag, ontology.struct, nullable=False, source=source, replaced=replaced
        )

    def metadata(self, values: Mapping[str, Value], scope: Scope | None) -> dict[str, Typed]:
        """Compile the expressions of `schema_metadata`."""
        found: dict[str, Typed] = {}
        for key, value in values.items():
            path = ("schema_metadata", key)
            if isinstance(value, Form):
                self.report(path, "metadata is an expression or a plain value", "drop the mapping")
                continue
            compiled = self.scalar(path, value, scope)
            if isinstance(compiled, Written) and compiled.typed is not None:
                found[key] = compiled.typed
            elif isinstance(compiled, Const):
                found[key] = compiled
        return found

    def report(self, path: Path, message: str, help_: str | None = None, *, rule: str = "mapping") -> None:
        """Note a mistake about a key or value."""
        self.findings.append(Finding(rule, Severity.ERROR, message, self._text.key_span(path), help_))

    def report_inside(
        self, path: Path, place: Place, rule: str, message: str, help_: str | None = None
    ) -> None:
        """Note a mistake in a part of an expression."""
        span = self._text.inner_span(path, *place)
        self.findings.append(Finding(rule, Severity.ERROR, message, span, help_))

    def expression(self, path: Path, text: str, scope: Scope | None) -> Written | None:
        """Read and type an expression; None after a finding."""
        try:
            node = parse(text)
        except ExpressionError as error:
            self.report_inside(path, error.place, "expression", str(error), error.hint)
            return None
        known = len(self.findings)
        self._check_calls(path, node)
        if len(self.findings) > known or scope is None:
            return Written(path, node, None) if len(self.findings) == known else None
        typed = self._checker(path, text, scope).infer(_without_cast(node))
        return None if typed is None else Written(path, node, typed)

    def scalar(self, path: Path, value: Scalar, scope: Scope | None) -> Written | Const | None:
        """Compile a plain value: text is an expression, anything else itself."""
        return self.expression(path, value, scope) if isinstance(value, str) else constant(value, str(value))

    def demand(self, at: Written | Path, kind: Kind, target: DataType) -> bool:
        """Check that an expression's values fit; otherwise note it."""
        try:
            demand(kind, target)
        except Unfit as unfit:
            if isinstance(at, Written):
                self.report_inside(at.path, at.node.at, "misfit", str(unfit), unfit.hint)
            else:
                span = self._text.span(at)
                self.findings.append(Finding("misfit", Severity.ERROR, str(unfit), span, unfit.hint))
            return False
        return True

    def _checker(self, path: Path, text: str, scope: Scope) -> Checker:
        def report(message: str, place: Place, help_: str | None) -> None:
            rule = "unknown-field" if message.startswith("no field") else "type"
            self.report_inside(path, place, rule, message, help_)

        return Checker(scope, report, text)

    def _check_calls(self, path: Path, node: Node) -> None:
        if isinstance(node, Call) and node.name not in _SPECIAL:
            function = lookup(node.name)
            if function is None:
                near = nearest(node.name, [f.name for f in functions()] + list(_SPECIAL))
                message = f"there is no function {node.name!r}"
                self.report_inside(path, node.name_at, "unknown-function", message, near)
            elif problem := function.arity_problem(len(node.arguments)):
                self.report_inside(path, node.at, "arguments", problem)
        elif (
            isinstance(node, Call)
            and not _SPECIAL[node.name][0] <= len(node.arguments) <= _SPECIAL[node.name][1]
        ):
            self.report_inside(path, node.at, "arguments", f"{node.name} is {_SPECIAL[node.name][2]}")
        for child in children(node):
            self._check_calls(path, child)

    def _optional_text(self, path: Path, value: object, scope: Scope | None) -> Written | None:
        if value is None:
            return None
        if not isinstance(value, str):
            self.report(path, "`of` is an expression", "name the field that holds the message")
            return None
        return self.expression(path, value, scope)

    def _inside(self, of: Written | None, scope: Scope | None) -> Scope | None:
        """Return the scope of the message that `of` gives; the outer one where nothing is said."""
        if of is None or scope is None:
            return scope
        if of.typed is None:
            return None
        element = of.typed.kind.element
        if pt.is_struct(element.type):
            return replace(scope, kind=element)
        hint = (
            f"write {of.typed.text}[]"
            if pt.is_list(element.type) or pt.is_fixed_size_list(element.type)
            else None
        )
        message = f"`{of.typed.text}` is {spell(element)}, not a message"
        self.report_inside(of.path, of.node.at, "type", message, hint)
        return None

    def _targets(
        self,
        values: Mapping[str, Value],
        at: Path,
        struct: DataType,
        scope: Scope | None,
        owner: str,
        *,
        skip: set[str] | None = None,
        prefix: str = "",
    ) -> tuple[Filled, ...] | None:
        """Compile the fields of a struct; None where one cannot be run."""
        filled: list[Filled | None] = []
        for name, value in values.items():
            if name in (skip or ()):
                continue
            position = struct.get_field_index(name)
            if position < 0:
                names = [field.name for field in struct]
                help_ = f"{nearest(name, names) or ''} it has {', '.join(names)}".strip()
                self.report((*at, name), f"{owner} has no field {name!r}", help_, rule="unknown-target")
                filled.append(None)
                continue
            filled.append(self._field(struct.field(position), value, (*at, name), scope, f"{prefix}{name}"))
        good = tuple(field for field in filled if field is not None)
        return good if len(good) == len(filled) else None

    def _require(self, struct: DataType, given: set[str], at: Path, owner: str) -> None:
        missing = [field.name for field in struct if not field.nullable and field.name not in given]
        if missing:
            message = f"{owner} requires {', '.join(missing)}"
            self.report(at, message, "say where each comes from", rule="missing-target")

    def _field(
        self, field: DataType, value: Value, path: Path, scope: Scope | None, name: str
    ) -> Filled | None:
        form = value if isinstance(value, Form) else None
        if form is not None and (problem := _form_problem(form)):
            self.report(path, problem[0], problem[1], rule="form")
            return None
        when = self._condition((*path, "when"), form.when, scope) if form and form.when else None
        replaced: tuple[Filled, ...] | None = ()
        if form is not None and form.replaced:
            replaced = self._with(form.replaced, (*path, "with"), field.type, scope, name)
        skip = set(form.replaced or ()) if form else set[str]()
        source = self._source(form, value, path, field.type, scope, name, skip)
        if not field.nullable and isinstance(source, Absent):
            self.report(
                path, f"{name} is required, it cannot be null", "give it a value", rule="missing-target"
            )
            return None
        if source is None or replaced is None or (form and form.when and when is None):
            return None
        typed = when.typed if when else None
        return Filled(name, field.name, field.type, field.nullable, source, replaced, typed)

    def _source(
        self,
        form: Form | None,
        value: Value,
        path: Path,
        target: DataType,
        scope: Scope | None,
        name: str,
        skip: set[str],
    ) -> Source | None:
        if form is None:
            return self._computed(path, value if not isinstance(value, Form) else None, target, scope)
        if form.use is not None:
            return self._by_adapter(form.use, form.of, path, target, scope)
        if form.fields is not None:
            return self._by_fields(form, path, target, scope, name, skip)
        if form.map is not None:
            return compile_lookup(self, form, path, target, scope)
        return self._computed((*path, "value"), form.value, target, scope)

    def _computed(self, path: Path, value: Scalar, target: DataType, scope: Scope | None) -> Source | None:
        if value is None:
            return Absent()
        compiled = self.scalar(path, value, scope)
        if compiled is None or isinstance(compiled, Const):
            return Computed(compiled) if compiled and self.demand(path, compiled.kind, target) else None
        typed = compiled.typed
        if typed is None:
            return None
        if isinstance(typed, Const) and typed.value is None:
            return Absent()
        if _is_short_cast(compiled.node):
            typed = self._cast(compiled, typed, target, scope)
            return Computed(typed) if typed is not None else None
        return Computed(typed) if self.demand(compiled, typed.kind, target) else None

    def _cast(self, written: Written, typed: Typed, target: DataType, scope: Scope | None) -> Typed | None:
        """Apply `cast(x)`: to whatever number the target is."""
        try:
            element = peel(target, typed.kind.axes)
        except Unfit as unfit:
            self.report_inside(written.path, written.node.at, "misfit", str(unfit), unfit.hint)
            return None
        if pt.is_nested(element) or pt.is_string(element) or pt.is_binary(element):
            message = f"cast makes numbers and booleans, the target is {spell(element)}"
            self.report_inside(written.path, written.node.at, "misfit", message)
            return None
        if scope is None:
            return None
        return self._checker(written.path, typed.text, scope).cast(typed, element, written.node)

    def _condition(self, path: Path, text: str, scope: Scope | None) -> Written | None:
        written = self.expression(path, text, scope)
        if written is None or written.typed is None:
            return None
        if written.typed.kind.axes or not pt.is_boolean(written.typed.kind.type):
            message = f"`when` is true or false for the whole value, not {spell(written.typed.kind)}"
            self.report_inside(path, written.node.at, "type", message, "compare it: x != 0; any(…) of a list")
            return None
        return written

    def _with(
        self, values: Mapping[str, Value], path: Path, target: DataType, scope: Scope | None, name: str
    ) -> tuple[Filled, ...] | None:
        while pt.is_list(target) or pt.is_fixed_size_list(target):
            target = target.value_type
        if not pt.is_struct(target):
            self.report(
                path, f"`with` sets fields of a struct, {name} is {spell(target)}", "drop it", rule="form"
            )
            return None
        return self._targets(values, path, target, scope, name, prefix=f"{name}.")

    def _by_fields(
        self, form: Form, path: Path, target: DataType, scope: Scope | None, name: str, skip: set[str]
    ) -> Source | None:
        of = self._optional_text((*path, "of"), form.of, scope)
        axes = of.typed.kind.axes if of and of.typed else ()
        if of is not None and of.typed is None:
            while pt.is_list(target) or pt.is_fixed_size_list(target):
                target = target.value_type
        try:
            element = peel(target, axes)
        except Unfit as unfit:
            self.report((*path, "of"), str(unfit), unfit.hint, rule="misfit")
            return None
        if not pt.is_struct(element):
            self.report((*path, "fields"), f"{name} is {spell(element)}, it has no fields", rule="misfit")
            return None
        if form.of is not None and of is None:
            return None
        at = (*path, "fields")
        fields = self._targets(
            form.fields or {}, at, element, self._inside(of, scope), name, skip=skip, prefix=f"{name}."
        )
        self._require(element, {*(form.fields or {}), *skip}, at, name)
        if fields is None or scope is None or (of is not None and of.typed is None):
            return None
        return ByFields(of.typed if of else None, _complete(fields, element))

    def _by_adapter(
        self, use: str, text: str | None, path: Path, target: DataType, scope: Scope | None
    ) -> Source | None:
        of = self.expression((*path, "of"), text or "self", scope)
        if of is None or of.typed is None or self._inside(of, scope) is None or self._definition is None:
            return None
        at, element = (*path, "use"), of.typed.kind.element
        spec = self._adapters(use) if self._adapters else None
        if spec is None:
            self.report(
                at,
                f"there is no adapter {use!r}",
                "`ingest adapters list` names them",
                rule="unknown-adapter",
            )
            return None
        if element.msgtype is None or element.msgtype not in spec.ros_types:
            message = f"{use} takes {', '.join(spec.ros_types)}, not {spell(element)}"
            self.report(at, message, "use another adapter, or say {of: …, fields: {…}}", rule="misfit")
            return None
        try:
            adapter = spec.bind(replace(self._definition, root=element.msgtype), element.type)
        except AdapterError as error:
            self.report(at, f"{use} cannot be used here: {error.what}", error.hint, rule="misfit")
            return None
        made = replace(kind_of(adapter.ontology.struct), axes=of.typed.kind.axes)
        return ByAdapter(of.typed, adapter, use, element.msgtype) if self.demand(of, made, target) else None


_SPECIAL = {
    "cast": (1, 2, "cast(x) or cast(x, 'int32')"),
    "either": (2, 99, "either(a, b, …)"),
    "if_else": (3, 3, "if_else(condition, then, otherwise)"),
}
"""What looks like a function and is not: fewest and most arguments, spelling."""


def _is_short_cast(node: Node) -> bool:
    return isinstance(node, Call) and node.name == "cast" and len(node.arguments) == 1


def _without_cast(node: Node) -> Node:
    return node.arguments[0] if isinstance(node, Call) and _is_short_cast(node) else node


def _form_problem(form: Form) -> tuple[str, str] | None:
    """Return what is wrong with the keys of a form taken together, and the remedy."""
    said = form.model_fields_set
    sources = [key for key in ("value", "use", "fields") if key in said]
    if len(sources) != 1:
        what = f"{' and '.join(sources)} are given" if sources else "nothing says where the value comes from"
        return what, "give one of value, use, fields"
    if "of" in said and sources == ["value"]:
        return "`of` goes with use or fields", "put the expression under value"
    if form.use is not None and form.of is None:
        return "`use` needs `of`: the message the other adapter takes", "as {use: PoseAdapter, of: pose}"
    if form.map is not None and sources != ["value"]:
        return "`map` goes with value", "put the expression under value"
    if "otherwise" in said and form.map is None:
        return "`else` goes with map", "write x if c else y in the expression"
    return None


def _complete(fields: tuple[Filled, ...], struct: DataType) -> tuple[Filled, ...]:
    """Return a field for each of the struct, in its order; what is not mentioned is null or replaced later."""
    known = {field.name: field for field in fields}
    return tuple(
        known.get(field.name) or Filled(field.name, field.name, field.type, nullable=True, source=Absent())
        for field in struct
    )
