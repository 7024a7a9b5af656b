"""Compile an adapter file to column operations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, TypeAlias

from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.mapping.checker import Analyzer, Scope, Target, is_short_cast, typed_constant
from mosaico_ingest.adapters.mapping.column_plan import (
    ColumnPlan,
    ColumnSource,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    NullColumn,
    StructSource,
)
from mosaico_ingest.adapters.mapping.columns import (
    DataType,
    arrays,
    pt,
)
from mosaico_ingest.adapters.mapping.conversion import check_fits
from mosaico_ingest.adapters.mapping.expressions import (
    AnalyzedExpression,
    Constant,
    FieldAccess,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.model import (
    MappingFile,
    Scalar,
    Value,
    ValueForm,
)
from mosaico_ingest.adapters.mapping.types import (
    TypeMismatch,
    common_type,
    expr_type_of,
    format_type,
    is_list,
    within,
)
from mosaico_ingest.errors import AdapterError, SinkError
from mosaico_ingest.ontology.types import NullRows, OntologyType
from mosaico_ingest.protocol import check_metadata
from mosaico_ingest.rosbag.definitions.model import Definition

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath

__all__ = ["AdapterLookup", "Compiler"]


def _compile_lookup(analyzer: Analyzer, form: ValueForm, slot: Target) -> MapLookup | None:
    """Return the compiled table, or None after a finding or where there is no message."""
    value = analyzer.scalar((*slot.path, "value"), form.value, slot.scope)
    typed = value.typed if isinstance(value, AnalyzedExpression) else value
    default = None
    if form.otherwise not in {"error", "keep"}:
        default = analyzer.scalar((*slot.path, "else"), form.otherwise, slot.scope)
        if default is None:
            return None
    if typed is None or slot.scope is None:
        return None
    element = analyzer.element_type((*slot.path, "value"), typed.type, slot.type)
    if element is None:
        return None
    table = _table(analyzer, form.map or {}, typed, replace(slot.at("map"), type=element))
    rest = (
        typed
        if form.otherwise == "keep"
        else default.typed
        if isinstance(default, AnalyzedExpression)
        else default
    )
    where = (*slot.path, "value" if form.otherwise == "keep" else "else")
    if table is None or (rest is not None and not analyzer.check_fits(where, rest.type.element, element)):
        return None
    return MapLookup(typed, arrays.array(table[0], typed.type.arrow), arrays.array(table[1], element), rest)


def _table(
    analyzer: Analyzer, entries: Mapping[Scalar, Scalar], typed: TypedExpression, slot: Target
) -> tuple[list[Scalar], list[Scalar]] | None:
    """Return keys and values that have the right types; None after a finding."""
    if pt.is_nested(slot.type) or pt.is_nested(typed.type.arrow):
        message = f"a map is between plain values, not {format_type(typed.type.element)} and {format_type(slot.type)}"
        analyzer.report(slot.path, message, rule="type-mismatch")
        return None
    keys = [_key(analyzer, key, typed, slot) for key in entries]
    fitting = [_value_fits(analyzer, value, (*slot.path, key), slot.type) for key, value in entries.items()]
    return (keys, list(entries.values())) if all(fitting) and None not in keys else None


def _value_fits(analyzer: Analyzer, value: Scalar, path: KeyPath, target: DataType) -> bool:
    try:
        check_fits(typed_constant(value).type, target)
    except TypeMismatch as unfit:
        analyzer.report_mismatch(path, unfit)
        return False
    return True


def _key(analyzer: Analyzer, key: Scalar, typed: TypedExpression, slot: Target) -> Scalar:
    """Return what a key stands for; None after a finding."""
    path, scope = (*slot.path, key), slot.scope
    if scope is None:
        return None
    kind, owner = typed.type.element, typed.operand.type if isinstance(typed, FieldAccess) else scope.message
    if isinstance(key, str) and not pt.is_string(kind.arrow):
        value = scope.constant(owner, key)
        if value is None:
            known = scope.types.get(owner.msgtype or "")
            names = ", ".join(c.name for c in known.constants) if known and known.constants else "none"
            analyzer.report(
                path,
                f"no constant {key!r} in {format_type(owner.element)}",
                f"it has {names}",
                rule="unknown-field",
            )
        return value
    own = typed_constant(key).type
    try:
        common_type([own, kind])
        fits = own.bounds is None or kind.bounds is None or within(own.bounds, kind.bounds)
    except TypeMismatch:
        fits = False
    if not fits or key is None:
        analyzer.report(
            path, f"`{typed.text}` is {format_type(kind)}, it is never {key!r}", rule="type-mismatch"
        )
        return None
    return key


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
    ) -> ColumnPlan | None:
        """Compile the whole record; None where a mistake or no scope leaves nothing to run."""
        slot = Target("", ontology.struct, (), scope, f"ontology {ontology.tag}")
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

    def metadata(self, values: Mapping[str, Value], scope: Scope | None) -> dict[str, TypedExpression]:
        """Compile the expressions of `schema_metadata`."""
        found: dict[str, TypedExpression] = {}
        for key, value in values.items():
            path = ("schema_metadata", key)
            try:
                check_metadata({key: None}, where="")
            except SinkError as refused:
                self._analyzer.report(path, refused.what, "give it another name")
                continue
            if isinstance(value, ValueForm):
                self._analyzer.report(path, "metadata is an expression or a plain value", "drop the mapping")
                continue
            compiled = self._analyzer.scalar(path, value, scope)
            typed = compiled.typed if isinstance(compiled, AnalyzedExpression) else compiled
            if typed is not None:
                found[key] = typed
        return found

    def _record(self, model: MappingFile, slot: Target, wrap: dict[str, Value]) -> ColumnPlan | None:
        said = wrap.pop("of", None)
        of = self._of(slot.at("of"), said)
        replaced = self._targets(wrap, slot)
        inner = replace(slot, path=("fields",), scope=self._analyzer.inside(of, slot.scope))
        fields = self._targets(model.fields, inner, skip=wrap.keys())
        self._require(inner, {*model.fields, *wrap})
        if slot.scope is None or fields is None or replaced is None or (said is not None and of is None):
            return None
        source = StructSource(of.typed if of else None, _complete(fields, slot))
        return ColumnPlan(slot.title, "", slot.type, nullable=False, source=source, overrides=replaced)

    def _of(self, slot: Target, said: Value) -> AnalyzedExpression | None:
        if said is None:
            return None
        if not isinstance(said, str):
            self._analyzer.report(slot.path, "`of` is an expression", "name the field that holds the message")
            return None
        return self._analyzer.expression(slot.path, said, slot.scope)

    def _targets(
        self, values: Mapping[str, Value], owner: Target, *, skip: AbstractSet[str] = frozenset()
    ) -> tuple[ColumnPlan, ...] | None:
        """Compile fields of a struct; None where one cannot be run."""
        filled = [self._target(name, value, owner) for name, value in values.items() if name not in skip]
        good = tuple(field for field in filled if field is not None)
        return good if len(good) == len(filled) else None

    def _target(self, name: str, value: Value, owner: Target) -> ColumnPlan | None:
        path = (*owner.path, name)
        position = owner.type.get_field_index(name)
        if position < 0:
            names = [field.name for field in owner.type]
            help_ = f"{suggest(name, names) or ''} it has {', '.join(names)}".strip()
            self._analyzer.report(path, f"{owner.title} has no field {name!r}", help_, rule="unknown-column")
            return None
        field = owner.type.field(position)
        full = owner.inside(name)
        return self._field(field, value, Target(full, field.type, path, owner.scope, full))

    def _require(self, owner: Target, given: AbstractSet[str]) -> None:
        missing = [field.name for field in owner.type if not field.nullable and field.name not in given]
        if missing:
            message = f"{owner.title} requires {', '.join(missing)}"
            self._analyzer.report(owner.path, message, "say where each comes from", rule="missing-column")

    def _field(self, field: DataType, value: Value, slot: Target) -> ColumnPlan | None:
        form = value if isinstance(value, ValueForm) else ValueForm.model_validate({"value": value})
        if problem := _form_problem(form):
            self._analyzer.report(slot.path, *problem, rule="field-form")
            return None
        replaced = self._with(form.replaced, slot.at("with")) if form.replaced else ()
        when = self._condition(form.when, slot.at("when")) if form.when else None
        source = self._source(form, slot, slot if form is not value else slot.at("value"))
        if not field.nullable and isinstance(source, NullColumn):
            message = f"{slot.name} is required, it cannot be null"
            self._analyzer.report(slot.path, message, "give it a value", rule="missing-column")
            return None
        if source is None or replaced is None or (form.when and when is None):
            return None
        return ColumnPlan(slot.name, field.name, field.type, field.nullable, source, replaced, when)

    def _source(self, form: ValueForm, slot: Target, written: Target) -> ColumnSource | None:
        if form.use is not None:
            return self._by_adapter(form.use, slot, form.of or "self")
        if form.fields is not None:
            return self._by_fields(form.fields, slot, form.of, set(form.replaced or ()))
        if form.map is not None:
            return _compile_lookup(self._analyzer, form, slot)
        return self._computed(form.value, written)

    def _computed(self, value: Scalar, slot: Target) -> ColumnSource | None:
        if value is None:
            return NullColumn(NullRows(slot.type))
        analyzer = self._analyzer
        compiled = analyzer.scalar(slot.path, value, slot.scope)
        if compiled is None or isinstance(compiled, Constant):
            return (
                ExpressionSource(compiled)
                if compiled and analyzer.check_fits(slot.path, compiled.type, slot.type)
                else None
            )
        typed = compiled.typed
        if typed is None:
            return None
        if isinstance(typed, Constant) and typed.value is None:
            return NullColumn(NullRows(slot.type))
        if is_short_cast(compiled.node):
            typed = analyzer.cast(compiled, slot)
            return None if typed is None else ExpressionSource(typed)
        return ExpressionSource(typed) if analyzer.check_fits(compiled, typed.type, slot.type) else None

    def _condition(self, text: str, slot: Target) -> TypedExpression | None:
        written = self._analyzer.expression(slot.path, text, slot.scope)
        if written is None or written.typed is None:
            return None
        if written.typed.type.axes or not pt.is_boolean(written.typed.type.arrow):
            message = f"`when` is true or false for the whole value, not {format_type(written.typed.type)}"
            hint = "compare it: x != 0; any(…) of a list"
            self._analyzer.report_inside(slot.path, written.node.span, "operand-type", message, hint)
            return None
        return written.typed

    def _with(self, values: Mapping[str, Value], slot: Target) -> tuple[ColumnPlan, ...] | None:
        element = _innermost(slot.type)
        if not pt.is_struct(element):
            message = f"`with` sets fields of a struct, {slot.name} is {format_type(element)}"
            self._analyzer.report(slot.path, message, "drop it", rule="field-form")
            return None
        return self._targets(values, replace(slot, type=element))

    def _by_fields(
        self, values: Mapping[str, Value], slot: Target, said: str | None, skip: AbstractSet[str]
    ) -> ColumnSource | None:
        of = self._of(slot.at("of"), said)
        if said is not None and of is None:
            return None
        typed = of.typed if of else None
        element = _innermost(slot.type) if of and not typed else slot.type
        if of and typed:
            element = self._analyzer.element_type(of, typed.type, slot.type)
            if element is None:
                return None
        inner = replace(slot.at("fields"), type=element, scope=self._analyzer.inside(of, slot.scope))
        if not pt.is_struct(element):
            message = f"{slot.name} is {format_type(element)}, it has no fields"
            self._analyzer.report(inner.path, message, "give an expression", rule="type-mismatch")
            return None
        fields = self._targets(values, inner, skip=skip)
        self._require(inner, {*values, *skip})
        if fields is None or inner.scope is None:
            return None
        return StructSource(typed, _complete(fields, inner))

    def _by_adapter(self, use: str, slot: Target, text: str) -> ColumnSource | None:
        analyzer = self._analyzer
        of = analyzer.expression((*slot.path, "of"), text, slot.scope)
        if (
            of is None
            or of.typed is None
            or analyzer.inside(of, slot.scope) is None
            or self._definition is None
        ):
            return None
        at, element = (*slot.path, "use"), of.typed.type.element
        spec = self._adapters(use) if self._adapters else None
        if spec is None:
            hint = "`ingest adapters list` names them"
            analyzer.report(at, f"there is no adapter {use!r}", hint, rule="unknown-adapter")
            return None
        if element.msgtype is None or element.msgtype not in spec.ros_types:
            message = f"{use} takes {', '.join(spec.ros_types)}, not {format_type(element)}"
            analyzer.report(
                at, message, "use another adapter, or say {of: …, fields: {…}}", rule="type-mismatch"
            )
            return None
        try:
            adapter = spec.bind(replace(self._definition, root=element.msgtype), element.arrow)
        except AdapterError as error:
            analyzer.report(at, f"{use} cannot be used here: {error.what}", error.hint, rule="type-mismatch")
            return None
        made = replace(expr_type_of(adapter.ontology.struct), axes=of.typed.type.axes)
        fits = analyzer.check_fits(of, made, slot.type)
        return NestedAdapter(of.typed, adapter, use, element.msgtype) if fits else None


def _innermost(type_: DataType) -> DataType:
    while is_list(type_):
        type_ = type_.value_type
    return type_


def _form_problem(form: ValueForm) -> tuple[str, str] | None:
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


def _complete(fields: tuple[ColumnPlan, ...], owner: Target) -> tuple[ColumnPlan, ...]:
    """Return a field for each of the struct, in its order; what is not mentioned is null or replaced later."""
    known = {field.name: field for field in fields}
    return tuple(known.get(field.name) or _absent(field, owner) for field in owner.type)


def _absent(field: DataType, owner: Target) -> ColumnPlan:
    return ColumnPlan(
        owner.inside(field.name),
        field.name,
        field.type,
        nullable=True,
        source=NullColumn(NullRows(field.type)),
    )
