"""This file compiles an adapter file: every mistake becomes a finding at its place, what is right becomes a plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import TypeAlias

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.mapping.analyzer import Analyzer, Slot, is_short_cast
from mosaico_ingest.adapters.mapping.arrow import DataType, pt
from mosaico_ingest.adapters.mapping.build import Absent, ByAdapter, ByFields, Computed, Filled, Source
from mosaico_ingest.adapters.mapping.check import Scope
from mosaico_ingest.adapters.mapping.functions.registry import nearest
from mosaico_ingest.adapters.mapping.kinds import is_list, kind_of, spell
from mosaico_ingest.adapters.mapping.lookup_table import compile_lookup
from mosaico_ingest.adapters.mapping.model import Form, MappingFile, Scalar, Value
from mosaico_ingest.adapters.mapping.typed import Const, Typed, Written
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.errors import AdapterError, SinkError
from mosaico_ingest.ontology.required import AbsentRows
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.wire import check_metadata

__all__ = ["AdapterLookup", "Compiler"]

AdapterLookup: TypeAlias = Callable[[str], "AdapterSpec | None"]
"""Finds an adapter by its name."""


class Compiler:
    """Compiles one file; with a definition for one message type, without it as far as one can see."""

    def __init__(
        self, analyzer: Analyzer, definition: Definition | None, adapters: AdapterLookup | None
    ) -> None:
        self._analyzer = analyzer
        self._definition = definition
        self._adapters = adapters

    def record(
        self, model: MappingFile, ontology: OntologyType, scope: Scope | None, variant: str | None
    ) -> Filled | None:
        """Compile the whole record; None where a mistake or no scope leaves nothing to run."""
        slot = Slot("", ontology.struct, (), scope, f"ontology {ontology.tag}")
        if model.variants is None:
            return self._record(model, slot, {})
        if variant is not None:
            return self._record(model, slot.at("variants", variant), dict(model.variants[variant]))
        for name, wrap in model.variants.items():
            known = len(self._analyzer.findings)
            self._record(model, slot.at("variants", name), dict(wrap))
            if len(self._analyzer.findings) > known:  # the same fields would be found wrong with each
                break
        return None

    def metadata(self, values: Mapping[str, Value], scope: Scope | None) -> dict[str, Typed]:
        """Compile the expressions of `schema_metadata`."""
        found: dict[str, Typed] = {}
        for key, value in values.items():
            path = ("schema_metadata", key)
            try:
                check_metadata({key: None}, where="")
            except SinkError as refused:
                self._analyzer.report(path, refused.what, "give it another name")
                continue
            if isinstance(value, Form):
                self._analyzer.report(path, "metadata is an expression or a plain value", "drop the mapping")
                continue
            compiled = self._analyzer.scalar(path, value, scope)
            typed = compiled.typed if isinstance(compiled, Written) else compiled
            if typed is not None:
                found[key] = typed
        return found

    def _record(self, model: MappingFile, slot: Slot, wrap: dict[str, Value]) -> Filled | None:
        said = wrap.pop("of", None)
        of = self._of(slot.at("of"), said)
        replaced = self._targets(wrap, slot)
        inner = replace(slot, path=("fields",), scope=self._analyzer.inside(of, slot.scope))
        fields = self._targets(model.fields, inner, skip=wrap.keys())
        self._require(inner, {*model.fields, *wrap})
        if slot.scope is None or fields is None or replaced is None or (said is not None and of is None):
            return None
        source = ByFields(of.typed if of else None, _complete(fields, slot))
        return Filled(slot.title, "", slot.type, nullable=False, source=source, replaced=replaced)

    def _of(self, slot: Slot, said: Value) -> Written | None:
        if said is None:
            return None
        if not isinstance(said, str):
            self._analyzer.report(slot.path, "`of` is an expression", "name the field that holds the message")
            return None
        return self._analyzer.expression(slot.path, said, slot.scope)

    def _targets(
        self, values: Mapping[str, Value], owner: Slot, *, skip: AbstractSet[str] = frozenset()
    ) -> tuple[Filled, ...] | None:
        """Compile fields of a struct; None where one cannot be run."""
        filled = [self._target(name, value, owner) for name, value in values.items() if name not in skip]
        good = tuple(field for field in filled if field is not None)
        return good if len(good) == len(filled) else None

    def _target(self, name: str, value: Value, owner: Slot) -> Filled | None:
        path = (*owner.path, name)
        position = owner.type.get_field_index(name)
        if position < 0:
            names = [field.name for field in owner.type]
            help_ = f"{nearest(name, names) or ''} it has {', '.join(names)}".strip()
            self._analyzer.report(path, f"{owner.title} has no field {name!r}", help_, rule="unknown-target")
            return None
        field = owner.type.field(position)
        full = owner.inside(name)
        return self._field(field, value, Slot(full, field.type, path, owner.scope, full))

    def _require(self, owner: Slot, given: AbstractSet[str]) -> None:
        missing = [field.name for field in owner.type if not field.nullable and field.name not in given]
        if missing:
            message = f"{owner.title} requires {', '.join(missing)}"
            self._analyzer.report(owner.path, message, "say where each comes from", rule="missing-target")

    def _field(self, field: DataType, value: Value, slot: Slot) -> Filled | None:
        form = value if isinstance(value, Form) else Form.model_validate({"value": value})
        if problem := _form_problem(form):
            self._analyzer.report(slot.path, *problem, rule="form")
            return None
        replaced = self._with(form.replaced, slot.at("with")) if form.replaced else ()
        when = self._condition(form.when, slot.at("when")) if form.when else None
        source = self._source(form, slot, slot if form is not value else slot.at("value"))
        if not field.nullable and isinstance(source, Absent):
            message = f"{slot.name} is required, it cannot be null"
            self._analyzer.report(slot.path, message, "give it a value", rule="missing-target")
            return None
        if source is None or replaced is None or (form.when and when is None):
            return None
        return Filled(slot.name, field.name, field.type, field.nullable, source, replaced, when)

    def _source(self, form: Form, slot: Slot, written: Slot) -> Source | None:
        if form.use is not None:
            return self._by_adapter(form.use, slot, form.of or "self")
        if form.fields is not None:
            return self._by_fields(form.fields, slot, form.of, set(form.replaced or ()))
        if form.map is not None:
            return compile_lookup(self._analyzer, form, slot)
        return self._computed(form.value, written)

    def _computed(self, value: Scalar, slot: Slot) -> Source | None:
        if value is None:
            return Absent(AbsentRows(slot.type))
        analyzer = self._analyzer
        compiled = analyzer.scalar(slot.path, value, slot.scope)
        if compiled is None or isinstance(compiled, Const):
            return (
                Computed(compiled)
                if compiled and analyzer.demand(slot.path, compiled.kind, slot.type)
                else None
            )
        typed = compiled.typed
        if typed is None:
            return None
        if isinstance(typed, Const) and typed.value is None:
            return Absent(AbsentRows(slot.type))
        if is_short_cast(compiled.node):
            typed = analyzer.cast(compiled, slot)
            return None if typed is None else Computed(typed)
        return Computed(typed) if analyzer.demand(compiled, typed.kind, slot.type) else None

    def _condition(self, text: str, slot: Slot) -> Typed | None:
        written = self._analyzer.expression(slot.path, text, slot.scope)
        if written is None or written.typed is None:
            return None
        if written.typed.kind.axes or not pt.is_boolean(written.typed.kind.type):
            message = f"`when` is true or false for the whole value, not {spell(written.typed.kind)}"
            hint = "compare it: x != 0; any(…) of a list"
            self._analyzer.report_inside(slot.path, written.node.at, "type", message, hint)
            return None
        return written.typed

    def _with(self, values: Mapping[str, Value], slot: Slot) -> tuple[Filled, ...] | None:
        element = _innermost(slot.type)
        if not pt.is_struct(element):
            message = f"`with` sets fields of a struct, {slot.name} is {spell(element)}"
            self._analyzer.report(slot.path, message, "drop it", rule="form")
            return None
        return self._targets(values, replace(slot, type=element))

    def _by_fields(
        self, values: Mapping[str, Value], slot: Slot, said: str | None, skip: AbstractSet[str]
    ) -> Source | None:
        of = self._of(slot.at("of"), said)
        if said is not None and of is None:
            return None
        typed = of.typed if of else None
        element = _innermost(slot.type) if of and not typed else slot.type
        if of and typed:
            element = self._analyzer.peeled(of, typed.kind, slot.type)
            if element is None:
                return None
        inner = replace(slot.at("fields"), type=element, scope=self._analyzer.inside(of, slot.scope))
        if not pt.is_struct(element):
            message = f"{slot.name} is {spell(element)}, it has no fields"
            self._analyzer.report(inner.path, message, "give an expression", rule="misfit")
            return None
        fields = self._targets(values, inner, skip=skip)
        self._require(inner, {*values, *skip})
        if fields is None or inner.scope is None:
            return None
        return ByFields(typed, _complete(fields, inner))

    def _by_adapter(self, use: str, slot: Slot, text: str) -> Source | None:
        analyzer = self._analyzer
        of = analyzer.expression((*slot.path, "of"), text, slot.scope)
        if (
            of is None
            or of.typed is None
            or analyzer.inside(of, slot.scope) is None
            or self._definition is None
        ):
            return None
        at, element = (*slot.path, "use"), of.typed.kind.element
        spec = self._adapters(use) if self._adapters else None
        if spec is None:
            hint = "`ingest adapters list` names them"
            analyzer.report(at, f"there is no adapter {use!r}", hint, rule="unknown-adapter")
            return None
        if element.msgtype is None or element.msgtype not in spec.ros_types:
            message = f"{use} takes {', '.join(spec.ros_types)}, not {spell(element)}"
            analyzer.report(at, message, "use another adapter, or say {of: …, fields: {…}}", rule="misfit")
            return None
        try:
            adapter = spec.bind(replace(self._definition, root=element.msgtype), element.type)
        except AdapterError as error:
            analyzer.report(at, f"{use} cannot be used here: {error.what}", error.hint, rule="misfit")
            return None
        made = replace(kind_of(adapter.ontology.struct), axes=of.typed.kind.axes)
        fits = analyzer.demand(of, made, slot.type)
        return ByAdapter(of.typed, adapter, use, element.msgtype) if fits else None


def _innermost(type_: DataType) -> DataType:
    while is_list(type_):
        type_ = type_.value_type
    return type_


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


def _complete(fields: tuple[Filled, ...], owner: Slot) -> tuple[Filled, ...]:
    """Return a field for each of the struct, in its order; what is not mentioned is null or replaced later."""
    known = {field.name: field for field in fields}
    return tuple(known.get(field.name) or _absent(field, owner) for field in owner.type)


def _absent(field: DataType, owner: Slot) -> Filled:
    return Filled(
        owner.inside(field.name), field.name, field.type, nullable=True, source=Absent(AbsentRows(field.type))
    )
