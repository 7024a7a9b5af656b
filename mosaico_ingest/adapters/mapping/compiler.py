"""Compile the fields of an adapter file to column plans."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from typing import Protocol

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec
from mosaico_ingest.adapters.mapping.checker import (
    Analyzer,
    Binding,
    Scope,
    Target,
    is_short_cast,
    typed_constant,
)
from mosaico_ingest.adapters.mapping.columns import (
    DataType,
    ExprType,
    TypeMismatch,
    arrays,
    common_type,
    expr_type_of,
    format_type,
    is_list,
    pt,
    within,
)
from mosaico_ingest.adapters.mapping.conversion import check_fits
from mosaico_ingest.adapters.mapping.evaluator import (
    ColumnPlan,
    ColumnSource,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    NullColumn,
    StructSource,
)
from mosaico_ingest.adapters.mapping.expressions import (
    AnalyzedExpression,
    Constant,
    FieldAccess,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.model import MappingFile, RecordModel, Scalar, Value, ValueForm
from mosaico_ingest.errors import AdapterError, SinkError
from mosaico_ingest.ontology.registry import NullRows, OntologyType
from mosaico_ingest.protocol import check_metadata
from mosaico_ingest.rosbag.definitions.model import Definition


class AdapterLookup(Protocol):
    """Finds the adapters that `use` names. It must survive pickling."""

    def __call__(self, name: str) -> AdapterSpec | None:
        """Return the adapter of a name, None if there is none."""
        ...

    def names(self) -> Iterable[str]:
        """Return the names of all adapters, for suggestions."""
        ...


class CompiledRecord(Struct, frozen=True):
    """The compiled content of one output of an adapter file."""

    plan: ColumnPlan
    """The record, or a list of records for each message."""
    drops: tuple[TypedExpression, ...] = ()
    """Conditions of which one is enough to drop a message."""
    levels: int = 0
    """The number of lists around the records of a message; 0 for one record per message."""


class Compiler:
    """Compiles one adapter file.

    With the definition of a message type, it returns column plans. Without a definition, it only reports the mistakes
    that do not depend on one, and returns None.
    """

    def __init__(
        self, analyzer: Analyzer, definition: Definition | None, adapters: AdapterLookup | None
    ) -> None:
        self._analyzer = analyzer
        self._definition = definition
        self._adapters = adapters

    def record(
        self,
        model: MappingFile,
        record: RecordModel,
        ontology: OntologyType,
        scope: Scope | None,
        variant: str | None,
    ) -> CompiledRecord | None:
        """Compile one output of a file; None after a finding or without a scope."""
        target = Target("", ontology.struct, (), scope, f"ontology {ontology.tag}")
        if model.variants is None:
            return self._record(model, record, target, {})
        if variant is not None:
            return self._record(model, record, target.at("variants", variant), dict(model.variants[variant]))
        for name, wrapper in model.variants.items():
            count = len(self._analyzer.findings)
            self._record(model, record, target.at("variants", name), dict(wrapper))
            # The variants share `fields` and would repeat its findings.
            if len(self._analyzer.findings) > count:
                break
        return None

    def metadata(self, record: RecordModel, scope: Scope | None) -> dict[str, TypedExpression]:
        """Compile the expressions of `schema_metadata` that have no finding."""
        compiled: dict[str, TypedExpression] = {}
        for key, value in record.schema_metadata.items():
            path = (*record.path, "schema_metadata", key)
            try:
                check_metadata({key: None}, where="")
            except SinkError as refused:
                self._analyzer.report(path, refused.what, "rename the key")
                continue
            if isinstance(value, ValueForm):
                self._analyzer.report_value(
                    path, "metadata takes an expression or a plain value", "remove the mapping"
                )
                continue
            analyzed = self._analyzer.scalar(path, value, scope)
            typed = analyzed.typed if isinstance(analyzed, AnalyzedExpression) else analyzed
            if typed is not None:
                compiled[key] = typed
        return compiled

    def _record(
        self, model: MappingFile, record: RecordModel, target: Target, wrapper: dict[str, Value]
    ) -> CompiledRecord | None:
        of_text = wrapper.pop("of", None)
        of = self._of(target.at("of"), of_text)
        overrides = self._columns(wrapper, target)
        payload = self._analyzer.nested_scope(of, target.scope)
        flat = target.scope
        if flat is not None and of is not None:
            of_typed = of.typed
            flat = None if of_typed is None else replace(flat, message=of_typed.type, subject=of_typed)
        flat = self._bind(model.let, flat)
        conditions = ((("drop_when",), model.drop_when), ((*record.path, "drop_when"), record.drop_when))
        drops = [
            self._condition(text, replace(target, path=path, scope=flat)) for path, text in conditions if text
        ]
        rows = self._rows(record, flat)
        if record.rows is not None:
            inner_scope = None if flat is None or rows is None else flat.nested(rows.type.element)
        else:
            inner_scope = flat if of is None else self._bind(model.let, payload)
        inner = replace(target, path=(*record.path, "fields"), scope=inner_scope)
        fields = self._columns(record.fields, inner, skip=wrapper.keys())
        self._check_required(inner, {*record.fields, *wrapper})
        if (
            inner_scope is None
            or fields is None
            or overrides is None
            or None in drops
            or (of_text is not None and of is None)
        ):
            return None
        operand = rows or (of.typed if of else None)
        source = StructSource(operand, _all_fields(fields, target))
        type_, levels = target.type, 0 if rows is None else len(rows.type.axes)
        for _ in range(levels):
            type_ = arrays.list_(type_)
        plan = ColumnPlan(target.title, "", type_, nullable=levels > 0, source=source, overrides=overrides)
        return CompiledRecord(plan, tuple(drop for drop in drops if drop is not None), levels)

    def _bind(self, values: Mapping[str, Scalar], scope: Scope | None) -> Scope | None:
        """Return the scope with the bindings of `let`; None after a finding, so that no name is reported as unknown."""
        complete = True
        for name, value in values.items():
            analyzed = self._analyzer.scalar(("let", name), value, scope)
            if isinstance(analyzed, AnalyzedExpression) and is_short_cast(analyzed.node):
                self._analyzer.report_inside(
                    analyzed.path,
                    analyzed.node.span,
                    "function-arguments",
                    "a binding has no column, so cast(x, 'type') needs the type",
                    "write the type, or cast the value where it is used",
                )
                analyzed = None
            typed = _typed(analyzed)
            if scope is None or typed is None:
                complete = False
            elif complete:
                scope = replace(scope, bindings={**scope.bindings, name: Binding(typed, scope.depth)})
        return scope if complete else None

    def _rows(self, record: RecordModel, scope: Scope | None) -> TypedExpression | None:
        """Compile `rows`; None without it, or after a finding."""
        if record.rows is None:
            return None
        path = (*record.path, "rows")
        analyzed = self._analyzer.expression(path, record.rows, scope)
        if analyzed is None or analyzed.typed is None:
            return None
        if not analyzed.typed.type.axes:
            closed = analyzed.typed.type
            hint = f"write {record.rows}[]" if is_list(closed.arrow) else "name a list, as in transforms[]"
            message = f"`rows` takes the elements of a list, not {format_type(closed)}"
            self._analyzer.report_inside(path, analyzed.node.span, "operand-type", message, hint)
            return None
        return analyzed.typed

    def _of(self, target: Target, text: Value) -> AnalyzedExpression | None:
        if text is None:
            return None
        if not isinstance(text, str):
            hint = "name the field that contains the message"
            self._analyzer.report_value(target.path, "`of` takes an expression", hint)
            return None
        return self._analyzer.expression(target.path, text, target.scope)

    def _columns(
        self, values: Mapping[str, Value], struct: Target, *, skip: AbstractSet[str] = frozenset()
    ) -> tuple[ColumnPlan, ...] | None:
        """Compile the fields of a struct; None if one of them has no plan."""
        plans = [
            self._named_column(name, value, struct) for name, value in values.items() if name not in skip
        ]
        valid = tuple(plan for plan in plans if plan is not None)
        return valid if len(valid) == len(plans) else None

    def _named_column(self, name: str, value: Value, struct: Target) -> ColumnPlan | None:
        path = (*struct.path, name)
        position = struct.type.get_field_index(name)
        if position < 0:
            names = [field.name for field in struct.type]
            hint = f"{suggest(name, names) or ''} it has {', '.join(names)}".strip()
            self._analyzer.report(path, f"{struct.title} has no field {name!r}", hint, rule="unknown-column")
            return None
        field = struct.type.field(position)
        full_name = struct.inside(name)
        return self._column(field, value, Target(full_name, field.type, path, struct.scope, full_name))

    def _check_required(self, struct: Target, names: AbstractSet[str]) -> None:
        missing = [field.name for field in struct.type if not field.nullable and field.name not in names]
        if missing:
            message = f"{struct.title} requires {', '.join(missing)}"
            hint = f"add {'it' if len(missing) == 1 else 'them'} to the fields"
            self._analyzer.report(struct.path, message, hint, rule="missing-column")

    def _column(self, field: DataType, value: Value, target: Target) -> ColumnPlan | None:
        form = value if isinstance(value, ValueForm) else ValueForm.model_validate({"value": value})
        if problem := _form_problem(form):
            self._analyzer.report(target.path, *problem, rule="field-form")
            return None
        overrides = self._overrides(form.replaced, target.at("with")) if form.replaced else ()
        when = self._condition(form.when, target.at("when")) if form.when else None
        source = self._source(form, target, target if form is not value else target.at("value"))
        if not field.nullable and isinstance(source, NullColumn):
            message = f"{target.name} is required and cannot be null"
            self._analyzer.report_value(target.path, message, "give it a value", rule="missing-column")
            return None
        if source is None or overrides is None or (form.when and when is None):
            return None
        return ColumnPlan(target.name, field.name, field.type, field.nullable, source, overrides, when)

    def _source(self, form: ValueForm, target: Target, value: Target) -> ColumnSource | None:
        """Compile the source of a column; `value` is the target with the key path of the form's expression."""
        if form.use is not None:
            return self._nested_adapter(form.use, target, form.of or "self")
        if form.fields is not None:
            return self._struct(form.fields, target, form.of, set(form.replaced or ()))
        if form.map is not None:
            return self._map_lookup(form, form.map, target)
        return self._expression(form.value, value)

    def _expression(self, value: Scalar, target: Target) -> ColumnSource | None:
        analyzer = self._analyzer
        if value is None:
            return NullColumn(NullRows(target.type))
        analyzed = analyzer.scalar(target.path, value, target.scope)
        if isinstance(analyzed, Constant):
            return ExpressionSource(analyzed) if self._literal_fits(analyzed, target) else None
        if analyzed is None or analyzed.typed is None:
            return None
        typed = analyzed.typed
        if isinstance(typed, Constant) and typed.value is None:
            return NullColumn(NullRows(target.type))
        if is_short_cast(analyzed.node):
            converted = analyzer.cast(analyzed, target)
            return None if converted is None else ExpressionSource(converted)
        return ExpressionSource(typed) if analyzer.check_fits(analyzed, typed.type, target.type) else None

    def _literal_fits(self, constant: Constant, target: Target) -> bool:
        """Check a number or boolean of the file; the message names the literal instead of its type."""
        try:
            check_fits(constant.type, target.type)
        except TypeMismatch as mismatch:
            fraction = isinstance(constant.value, float) and pt.is_integer(target.type)
            message = f"{constant.text} does not fit {format_type(target.type)}"
            hint = "write an integer" if fraction else mismatch.hint
            self._analyzer.report_value(target.path, message, hint, rule="type-mismatch")
            return False
        return True

    def _condition(self, text: str, target: Target) -> TypedExpression | None:
        condition = self._analyzer.expression(target.path, text, target.scope)
        if condition is None or condition.typed is None:
            return None
        if condition.typed.type.axes or not pt.is_boolean(condition.typed.type.arrow):
            key = target.path[-1]
            message = f"`{key}` takes one boolean per row, not {format_type(condition.typed.type)}"
            hint = "compare a number with x != 0, or reduce a list with any(…)"
            self._analyzer.report_inside(target.path, condition.node.span, "operand-type", message, hint)
            return None
        return condition.typed

    def _overrides(self, values: Mapping[str, Value], target: Target) -> tuple[ColumnPlan, ...] | None:
        """Compile the fields of `with`."""
        element = _innermost(target.type)
        if not pt.is_struct(element):
            message = f"`with` sets the fields of a struct, {target.name} is {format_type(element)}"
            self._analyzer.report(target.path, message, "remove `with`", rule="field-form")
            return None
        return self._columns(values, replace(target, type=element))

    def _struct(
        self, values: Mapping[str, Value], target: Target, of_text: str | None, skip: AbstractSet[str]
    ) -> ColumnSource | None:
        of = self._of(target.at("of"), of_text)
        if of_text is not None and of is None:
            return None
        typed = of.typed if of else None
        element = _innermost(target.type) if of and not typed else target.type
        if of and typed:
            element = self._analyzer.element_type(of, typed.type, target.type)
            if element is None:
                return None
        scope = self._analyzer.nested_scope(of, target.scope)
        inner = replace(target.at("fields"), type=element, scope=scope)
        if not pt.is_struct(element):
            message = f"{target.name} is {format_type(element)}, it has no fields"
            self._analyzer.report(inner.path, message, "write an expression", rule="type-mismatch")
            return None
        fields = self._columns(values, inner, skip=skip)
        self._check_required(inner, {*values, *skip})
        if fields is None or inner.scope is None:
            return None
        return StructSource(typed, _all_fields(fields, inner))

    def _nested_adapter(self, use: str, target: Target, text: str) -> ColumnSource | None:
        of = self._analyzer.expression((*target.path, "of"), text, target.scope)
        definition = self._definition
        if definition is None:
            return None
        spec = self._find_adapter(use, target)
        if spec is None or of is None or of.typed is None:
            return None
        element = of.typed.type.element
        adapter = (
            self._bind_adapter(spec, element, definition, target) if self._is_message(of, target) else None
        )
        if adapter is None:
            return None
        result = replace(expr_type_of(adapter.ontology.struct), axes=of.typed.type.axes)
        if not self._analyzer.check_fits(of, result, target.type):
            return None
        return NestedAdapter(of.typed, adapter, use, str(element.msgtype))

    def _is_message(self, of: AnalyzedExpression, target: Target) -> bool:
        return self._analyzer.nested_scope(of, target.scope) is not None

    def _find_adapter(self, use: str, target: Target) -> AdapterSpec | None:
        spec = self._adapters(use) if self._adapters else None
        if spec is None:
            names = self._adapters.names() if self._adapters else ()
            hint = suggest(use, names) or "run `ingest adapters list` for their names"
            path = (*target.path, "use")
            self._analyzer.report_value(path, f"there is no adapter {use!r}", hint, rule="unknown-adapter")
        return spec

    def _bind_adapter(
        self, spec: AdapterSpec, message: ExprType, definition: Definition, target: Target
    ) -> Adapter | None:
        """Bind another adapter to a nested message; None after a finding."""
        path = (*target.path, "use")
        if message.msgtype is None or message.msgtype not in spec.ros_types:
            text = f"{spec.name} takes {', '.join(spec.ros_types)}, not {format_type(message)}"
            hint = "use another adapter, or write {of: …, fields: {…}}"
            self._analyzer.report_value(path, text, hint, rule="type-mismatch")
            return None
        try:
            adapter = spec.bind(replace(definition, root=message.msgtype), message.arrow)
        except AdapterError as error:
            text = f"{spec.name} does not fit the message: {error.what}"
            self._analyzer.report_value(path, text, error.hint, rule="type-mismatch")
            return None
        if getattr(adapter, "is_plain", True):
            return adapter
        text = f"{spec.name} does not make exactly one row of each message"
        hint = "use an adapter without drop_when, rows and outputs"
        self._analyzer.report_value(path, text, hint, rule="type-mismatch")
        return None

    def _map_lookup(
        self, form: ValueForm, entries: Mapping[Scalar, Scalar], target: Target
    ) -> MapLookup | None:
        analyzer = self._analyzer
        operand = _typed(analyzer.scalar((*target.path, "value"), form.value, target.scope))
        if operand is None or target.scope is None:
            return None
        element = analyzer.element_type((*target.path, "value"), operand.type, target.type)
        if element is None:
            return None
        inner = replace(target, type=element)
        table = self._map_entries(entries, operand, inner.at("map"))
        default = None
        if form.otherwise == "keep":
            default = operand
            if not analyzer.check_fits((*target.path, "value"), operand.type.element, element):
                return None
        elif form.otherwise != "error":
            default = self._replacement(form.otherwise, inner.at("else"))
            if default is None:
                return None
        if table is None:
            return None
        keys, values = table
        return MapLookup(
            operand, arrays.array(keys, operand.type.arrow), arrays.array(values, element), default
        )

    def _map_entries(
        self, entries: Mapping[Scalar, Scalar], operand: TypedExpression, target: Target
    ) -> tuple[list[Scalar], list[Scalar]] | None:
        """Return the keys and values of a map; None after a finding."""
        if pt.is_nested(target.type) or pt.is_nested(operand.type.arrow):
            types = f"{format_type(operand.type.element)} and {format_type(target.type)}"
            self._analyzer.report(
                target.path, f"`map` relates plain values, not {types}", rule="type-mismatch"
            )
            return None
        keys = [self._map_key(key, operand, target) for key in entries]
        values = [
            self._constant(value, replace(target, path=(*target.path, key))) for key, value in entries.items()
        ]
        constants = [value.value for value in values if value is not None]
        return (keys, constants) if len(constants) == len(keys) and None not in keys else None

    def _constant(self, value: Scalar, target: Target) -> Constant | None:
        """Return a value of a map, which is the same for every row; None after a finding."""
        bare = isinstance(value, str) and value.strip().isidentifier()
        if bare and pt.is_string(target.type):
            message = f"{value} is a name here, not text"
            hint = f"write \"'{value}'\" for the text, or ({value}) for a constant"
            self._analyzer.report_value(target.path, message, hint, rule="ambiguous-text")
            return None
        typed = self._replacement(value, target)
        if typed is None or isinstance(typed, Constant):
            return typed
        message = f"`{typed.text}` is not a constant"
        hint = "write a literal, a constant of the message type or a parameter"
        self._analyzer.report_value(target.path, message, hint, rule="operand-type")
        return None

    def _replacement(self, value: Scalar, target: Target) -> TypedExpression | None:
        """Return a value of `map` or `else`: text is an expression, anything else a literal; None after a finding."""
        analyzed = self._analyzer.scalar(target.path, value, target.scope)
        if isinstance(analyzed, Constant):
            return analyzed if self._literal_fits(analyzed, target) else None
        if analyzed is None or analyzed.typed is None:
            return None
        fits = self._analyzer.check_fits(target.path, analyzed.typed.type.element, target.type)
        return analyzed.typed if fits else None

    def _map_key(self, key: Scalar, operand: TypedExpression, target: Target) -> Scalar:
        """Return the value of a key, which may name a constant of the message; None after a finding."""
        path, scope = (*target.path, key), target.scope
        if scope is None:
            return None
        expr_type = operand.type.element
        if isinstance(key, str) and not pt.is_string(expr_type.arrow):
            owner = operand.operand.type if isinstance(operand, FieldAccess) else scope.message
            constants = scope.constants(owner)
            if key not in constants:
                message = f"no constant {key!r} in {format_type(owner.element)}"
                hint = f"it has {', '.join(constants) or 'none'}"
                nearest = suggest(key, constants)
                hint = f"{nearest} {hint}" if nearest else hint
                self._analyzer.report(path, message, hint, rule="unknown-field")
            return constants.get(key)
        constant = typed_constant(key).type
        try:
            common_type([constant, expr_type])
            fits = (
                constant.bounds is None
                or expr_type.bounds is None
                or within(constant.bounds, expr_type.bounds)
            )
        except TypeMismatch:
            fits = False
        if not fits or key is None:
            message = f"`{operand.text}` is {format_type(expr_type)} and never {key!r}"
            self._analyzer.report(path, message, rule="type-mismatch")
            return None
        return key


def _typed(analyzed: AnalyzedExpression | Constant | None) -> TypedExpression | None:
    return analyzed.typed if isinstance(analyzed, AnalyzedExpression) else analyzed


def _innermost(type_: DataType) -> DataType:
    """Return the element type below all lists."""
    while is_list(type_):
        type_ = type_.value_type
    return type_


def _form_problem(form: ValueForm) -> tuple[str, str] | None:
    """Return the message and the hint for an invalid combination of keys, None if it is valid."""
    keys = form.model_fields_set
    sources = [key for key in ("value", "use", "fields") if key in keys]
    problems = (
        (not sources, "the value has no source", "give one of value, use, fields"),
        (len(sources) > 1, f"{' and '.join(sources)} exclude each other", "keep one of value, use, fields"),
        (
            "of" in keys and sources == ["value"],
            "`of` requires `use` or `fields`",
            "write the expression under `value`",
        ),
        (
            form.use is not None and form.of is None,
            "`use` requires `of`, the message for the other adapter",
            "write {use: PoseAdapter, of: pose}",
        ),
        (
            form.map is not None and sources != ["value"],
            "`map` requires `value`",
            "write the expression under `value`",
        ),
        (
            "otherwise" in keys and form.map is None,
            "`else` requires `map`",
            "write `x if c else y` in the expression",
        ),
    )
    return next(((message, hint) for applies, message, hint in problems if applies), None)


def _all_fields(plans: tuple[ColumnPlan, ...], struct: Target) -> tuple[ColumnPlan, ...]:
    """Return a plan for each field of a struct, in its order; fields without a plan are null."""
    by_name = {plan.name: plan for plan in plans}
    return tuple(by_name.get(field.name) or _null_column(field, struct) for field in struct.type)


def _null_column(field: DataType, struct: Target) -> ColumnPlan:
    source = NullColumn(NullRows(field.type))
    return ColumnPlan(struct.inside(field.name), field.name, field.type, nullable=True, source=source)
