"""Compile an adapter file to column operations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.mapping.checker import Analyzer, Scope, Slot, constant, is_short_cast
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    Column,
    DataType,
    Mask,
    arrays,
    null_where,
    nulls,
    one_type,
    pc,
    pt,
    struct_of,
)
from mosaico_ingest.adapters.mapping.conversion import convert, demand, refuse_nulls
from mosaico_ingest.adapters.mapping.evaluator import Evaluation, Refusal, RowsRefused
from mosaico_ingest.adapters.mapping.functions.registry import Refuse, nearest
from mosaico_ingest.adapters.mapping.model import (
    Form,
    MappingFile,
    Scalar,
    Value,
)
from mosaico_ingest.adapters.mapping.typed import Const, FieldOf, Typed, Written
from mosaico_ingest.adapters.mapping.types import (
    Unfit,
    is_list,
    join,
    kind_of,
    spell,
    within,
)
from mosaico_ingest.errors import AdapterError, SinkError
from mosaico_ingest.ontology.types import AbsentRows, OntologyType
from mosaico_ingest.protocol import check_metadata
from mosaico_ingest.rosbag.definitions.model import Definition

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath

__all__ = [
    "Absent",
    "AdapterLookup",
    "ByAdapter",
    "ByFields",
    "Compiler",
    "Computed",
    "Filled",
    "Looked",
    "Source",
    "compile_lookup",
    "fill",
    "fill_struct",
]


class Absent(Struct, frozen=True):
    """Nothing: null in every row."""

    rows: AbsentRows


class Computed(Struct, frozen=True):
    """An expression."""

    typed: Typed


class Looked(Struct, frozen=True):
    """A value looked up in a table."""

    typed: Typed
    keys: Any
    """The values looked for, an Arrow array."""
    values: Any
    """What each becomes, an Arrow array."""
    otherwise: Typed | None
    """For a value that is not there; None: the row is rejected."""


class ByAdapter(Struct, frozen=True):
    """What another adapter makes of a nested message."""

    of: Typed
    adapter: Adapter
    name: str
    msgtype: str


class ByFields(Struct, frozen=True):
    """A struct, field by field; with `of`, names are read inside it."""

    of: Typed | None
    fields: tuple[Filled, ...]


Source: TypeAlias = "Absent | Computed | Looked | ByAdapter | ByFields"


class Filled(Struct, frozen=True):
    """One column of the ontology and where it comes from."""

    path: str
    """Its name with those around it, as `pose.position`."""
    name: str
    type: DataType
    nullable: bool
    source: Source
    replaced: tuple[Filled, ...] = ()
    """Fields of the struct that come from elsewhere (`with`)."""
    when: Typed | None = None


def fill_struct(evaluation: Evaluation, fields: tuple[Filled, ...], type_: DataType) -> Array:
    """Return a struct of all the fields, one value a row.

    Raises:
        RowsRefused: Some rows do not fit.
    """
    return struct_of([fill(evaluation, field) for field in fields], type_, None, len(evaluation))


def fill(evaluation: Evaluation, field: Filled) -> Array:
    """Return one column in its exact type, one value a row.

    Raises:
        RowsRefused: Some rows do not fit.
    """
    if field.when is None:
        array = _fill(evaluation, field)
    else:
        condition = evaluation.mask(field.when)
        with evaluation.within(Column(arrays.array(condition))):
            array = _fill(evaluation, field)
        array = null_where(array, ~condition)
    if field.nullable:
        return array
    evaluation.target = field.path
    return refuse_nulls(array, None, evaluation.refuser((), field.path))


def _fill(evaluation: Evaluation, field: Filled) -> Array:
    evaluation.target = field.path
    source = field.source
    if isinstance(source, Computed) and not field.replaced:
        column = evaluation.of(source.typed)
        types = _types(field.type, column.axes)
        values = _converted(evaluation, column, types[-1], source.typed.text)
    elif isinstance(source, Absent):
        return source.rows.of(len(evaluation))
    else:
        column = _base(evaluation, field)
        types = _types(field.type, column.axes)
        values = _replaced(evaluation, field, column, types[-1])
    for axis, type_ in zip(reversed(column.axes), reversed(types[:-1]), strict=True):
        values = _closed(axis, values, type_, evaluation.refuser(column.axes[:-1], field.path))
    return values


def _types(target: DataType, axes: tuple[Axis, ...]) -> list[DataType]:
    """Return the type of the column and of the elements of each list opened, outermost first."""
    types = [target]
    for _ in axes:
        types.append(types[-1].value_type)
    return types


def _closed(axis: Axis, values: Array, type_: DataType, refuse: Refuse) -> Array:
    same = axis.size is None and not hasattr(type_, "list_size")
    if same or axis.size == getattr(type_, "list_size", None):
        return axis.close(values, type_)
    return convert(axis.close(values), type_, refuse)


def _converted(evaluation: Evaluation, column: Column, target: DataType, text: str) -> Array:
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    return convert(column.array(count), target, evaluation.refuser(column.axes, text))


def _base(evaluation: Evaluation, field: Filled) -> Column:
    """Return the values before `with`, already in the element's type."""
    source = field.source
    match source:
        case Absent():
            return Column(source.rows.of(len(evaluation)))
        case Computed():
            column = evaluation.of(source.typed)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.typed.text), column.axes)
        case Looked():
            column = _looked_up(evaluation, source)
            element = _types(field.type, column.axes)[-1]
            return Column(_converted(evaluation, column, element, source.typed.text), column.axes)
        case ByAdapter():
            column = evaluation.of(source.of)
            refuse = evaluation.refuser(column.axes, source.of.text)
            run = _adapting(evaluation, source, column)
            return Column(
                _over_valid(column.array(0), _types(field.type, column.axes)[-1], run, refuse), column.axes
            )
        case ByFields():
            return _by_fields(evaluation, field, source)


def _by_fields(evaluation: Evaluation, field: Filled, source: ByFields) -> Column:
    if source.of is None:
        return Column(fill_struct(evaluation, source.fields, field.type))
    column = evaluation.of(source.of)
    element = _types(field.type, column.axes)[-1]

    def run(rows: Array, positions: Mask) -> Array:
        inner = Evaluation(rows, _envelope(evaluation.envelope, column.axes, positions))
        return fill_struct(inner, source.fields, element)

    refuse = evaluation.refuser(column.axes, None)
    return Column(_over_valid(column.array(0), element, run, refuse), column.axes)


def _envelope(envelope: Envelope, axes: tuple[Axis, ...], rows: Any) -> Envelope:  # noqa: ANN401 - row positions
    for axis in reversed(axes):
        rows = axis.parents[rows]
    return replace(envelope, log_times=envelope.log_times[rows])


def _adapting(evaluation: Evaluation, source: ByAdapter, column: Column) -> Callable[[Array, Any], Array]:
    def run(rows: Array, positions: Mask) -> Array:
        envelope = _envelope(evaluation.envelope, column.axes, positions)
        adapted = source.adapter.adapt(rows, replace(envelope, msgtype=source.msgtype))
        if adapted.failures:
            raise RowsRefused({f.row: (f.rule, f"{source.name}: {f.reason}") for f in adapted.failures})
        return adapted.rows

    return run


def _over_valid(rows: Array, type_: DataType, run: Callable[[Array, Any], Array], refuse: Refuse) -> Array:
    """Run over the rows that are not null, and leave out those that are refused but do not count."""
    absent = nulls(rows)
    good = np.ones(len(rows), bool) if absent is None else ~absent
    while True:
        positions = np.flatnonzero(good)
        try:
            result = run(rows if good.all() else rows.filter(arrays.array(good)), positions)
            break
        except RowsRefused as refused:
            said = {int(positions[row]): why for row, why in refused.refusals.items()}
            _refuse_each(said, len(rows), refuse)
            good[list(said)] = False
    result = convert(result, type_, refuse)
    if good.all():
        return result
    where = np.full(len(rows), -1, np.int64)
    where[positions] = np.arange(len(positions))
    return result.take(arrays.array(np.maximum(where, 0), mask=where < 0))


def _refuse_each(said: dict[int, Refusal], count: int, refuse: Refuse) -> None:
    """Hand on refusals of elements, those of one rule together."""
    for rule in dict.fromkeys(rule for rule, _ in said.values()):
        bad = np.zeros(count, bool)
        bad[[row for row, (own, _) in said.items() if own == rule]] = True
        refuse(bad, rule, lambda i: said[i][1])


def _looked_up(evaluation: Evaluation, source: Looked) -> Column:
    column = evaluation.of(source.typed)
    count = len(column.axes[-1].parents) if column.axes else len(evaluation)
    values = column.array(count)
    index = pc.index_in(values, value_set=pc.cast(source.keys, values.type))
    found = source.values.take(index)
    unknown = np.asarray(pc.and_(pc.is_null(index), pc.is_valid(values)))
    if not unknown.any():
        return Column(found, column.axes)
    if source.otherwise is None:
        known = ", ".join(str(key) for key in source.keys.to_pylist())
        refuse = evaluation.refuser(column.axes, source.typed.text)
        refuse(unknown, "unmapped", lambda i: f"{values[i].as_py()!r} is not in the map ({known})")
        return Column(found, column.axes)
    with evaluation.within(Column(arrays.array(unknown), column.axes)):
        rest = evaluation.of(source.otherwise).over(column.axes).array(count)
    found, rest = one_type(found, rest)
    return Column(pc.if_else(arrays.array(unknown), rest, found), column.axes)


def _replaced(evaluation: Evaluation, field: Filled, column: Column, type_: DataType) -> Array:
    """Return the struct with the fields of `with` in place."""
    struct = column.values
    if not field.replaced:
        return struct
    children = [struct.field(i) for i in range(type_.num_fields)]
    for replaced in field.replaced:
        value = Column(fill(evaluation, replaced)).over(column.axes).array(0)
        children[type_.get_field_index(replaced.name)] = value
    return struct_of(children, type_, nulls(struct), len(struct))


def compile_lookup(analyzer: Analyzer, form: Form, slot: Slot) -> Looked | None:
    """Return the compiled table, or None after a finding or where there is no message."""
    value = analyzer.scalar((*slot.path, "value"), form.value, slot.scope)
    typed = value.typed if isinstance(value, Written) else value
    default = None
    if form.otherwise not in {"error", "keep"}:
        default = analyzer.scalar((*slot.path, "else"), form.otherwise, slot.scope)
        if default is None:
            return None
    if typed is None or slot.scope is None:
        return None
    element = analyzer.peeled((*slot.path, "value"), typed.kind, slot.type)
    if element is None:
        return None
    table = _table(analyzer, form.map or {}, typed, replace(slot.at("map"), type=element))
    rest = typed if form.otherwise == "keep" else default.typed if isinstance(default, Written) else default
    where = (*slot.path, "value" if form.otherwise == "keep" else "else")
    if table is None or (rest is not None and not analyzer.demand(where, rest.kind.element, element)):
        return None
    return Looked(typed, arrays.array(table[0], typed.kind.type), arrays.array(table[1], element), rest)


def _table(
    analyzer: Analyzer, entries: Mapping[Scalar, Scalar], typed: Typed, slot: Slot
) -> tuple[list[Scalar], list[Scalar]] | None:
    """Return keys and values that have the right types; None after a finding."""
    if pt.is_nested(slot.type) or pt.is_nested(typed.kind.type):
        message = f"a map is between plain values, not {spell(typed.kind.element)} and {spell(slot.type)}"
        analyzer.report(slot.path, message, rule="type-mismatch")
        return None
    keys = [_key(analyzer, key, typed, slot) for key in entries]
    fitting = [_value_fits(analyzer, value, (*slot.path, key), slot.type) for key, value in entries.items()]
    return (keys, list(entries.values())) if all(fitting) and None not in keys else None


def _value_fits(analyzer: Analyzer, value: Scalar, path: KeyPath, target: DataType) -> bool:
    try:
        demand(constant(value).kind, target)
    except Unfit as unfit:
        analyzer.misfit(path, unfit)
        return False
    return True


def _key(analyzer: Analyzer, key: Scalar, typed: Typed, slot: Slot) -> Scalar:
    """Return what a key stands for; None after a finding."""
    path, scope = (*slot.path, key), slot.scope
    if scope is None:
        return None
    kind, owner = typed.kind.element, typed.of.kind if isinstance(typed, FieldOf) else scope.kind
    if isinstance(key, str) and not pt.is_string(kind.type):
        value = scope.constant(owner, key)
        if value is None:
            known = scope.types.get(owner.msgtype or "")
            names = ", ".join(c.name for c in known.constants) if known and known.constants else "none"
            analyzer.report(
                path,
                f"no constant {key!r} in {spell(owner.element)}",
                f"it has {names}",
                rule="unknown-field",
            )
        return value
    own = constant(key).kind
    try:
        join([own, kind])
        fits = own.bounds is None or kind.bounds is None or within(own.bounds, kind.bounds)
    except Unfit:
        fits = False
    if not fits or key is None:
        analyzer.report(path, f"`{typed.text}` is {spell(kind)}, it is never {key!r}", rule="type-mismatch")
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
            self._analyzer.report(path, f"{owner.title} has no field {name!r}", help_, rule="unknown-column")
            return None
        field = owner.type.field(position)
        full = owner.inside(name)
        return self._field(field, value, Slot(full, field.type, path, owner.scope, full))

    def _require(self, owner: Slot, given: AbstractSet[str]) -> None:
        missing = [field.name for field in owner.type if not field.nullable and field.name not in given]
        if missing:
            message = f"{owner.title} requires {', '.join(missing)}"
            self._analyzer.report(owner.path, message, "say where each comes from", rule="missing-column")

    def _field(self, field: DataType, value: Value, slot: Slot) -> Filled | None:
        form = value if isinstance(value, Form) else Form.model_validate({"value": value})
        if problem := _form_problem(form):
            self._analyzer.report(slot.path, *problem, rule="field-form")
            return None
        replaced = self._with(form.replaced, slot.at("with")) if form.replaced else ()
        when = self._condition(form.when, slot.at("when")) if form.when else None
        source = self._source(form, slot, slot if form is not value else slot.at("value"))
        if not field.nullable and isinstance(source, Absent):
            message = f"{slot.name} is required, it cannot be null"
            self._analyzer.report(slot.path, message, "give it a value", rule="missing-column")
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
            self._analyzer.report_inside(slot.path, written.node.at, "operand-type", message, hint)
            return None
        return written.typed

    def _with(self, values: Mapping[str, Value], slot: Slot) -> tuple[Filled, ...] | None:
        element = _innermost(slot.type)
        if not pt.is_struct(element):
            message = f"`with` sets fields of a struct, {slot.name} is {spell(element)}"
            self._analyzer.report(slot.path, message, "drop it", rule="field-form")
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
            self._analyzer.report(inner.path, message, "give an expression", rule="type-mismatch")
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
            analyzer.report(
                at, message, "use another adapter, or say {of: …, fields: {…}}", rule="type-mismatch"
            )
            return None
        try:
            adapter = spec.bind(replace(self._definition, root=element.msgtype), element.type)
        except AdapterError as error:
            analyzer.report(at, f"{use} cannot be used here: {error.what}", error.hint, rule="type-mismatch")
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
