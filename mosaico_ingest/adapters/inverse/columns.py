"""Invert a compiled mapping: assign column values to the message fields they came from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.inverse.message_builder import (
    CLOUD_FUNCTIONS,
    EACH_ELEMENT,
    CloudField,
    FieldPath,
    MessageBuilder,
    pack_clouds,
)
from mosaico_ingest.adapters.mapping.columns import (
    SECOND_NS,
    Array,
    Axis,
    Mask,
    arrays,
    field_of,
    is_number,
    null_mask,
    open_list,
    pc,
    pt,
    time_ns,
    true_mask,
)
from mosaico_ingest.adapters.mapping.evaluator import (
    ColumnPlan,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    NullColumn,
    StructSource,
)
from mosaico_ingest.adapters.mapping.expressions import (
    Cast,
    Conditional,
    Constant,
    ElementAt,
    EnvelopeField,
    FieldAccess,
    FunctionCall,
    LiteralValue,
    MakeList,
    MessageRef,
    OpenList,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.ros import HEADER_TYPE, STAMP_TYPE
from mosaico_ingest.adapters.mapping.loader import MappingAdapter


def _same(values: Array) -> Array:
    return values


def _nan(values: Array) -> Array:
    return pc.fill_null(values, arrays.scalar(float("nan"), values.type))


def _yaw(quaternion: Array) -> Array:
    x, y, z, w = (np.asarray(field_of(quaternion, name).fill_null(0.0)) for name in "xyzw")
    return arrays.array(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _from_seconds(values: Array) -> Array:
    return _from_ns(pc.round(pc.multiply(values, float(SECOND_NS))))


def _from_ns(values: Array) -> Array:
    whole = np.asarray(filled_int(values))
    seconds, rest = np.divmod(whole, SECOND_NS)
    children = [arrays.array(seconds.astype(np.int32)), arrays.array(rest.astype(np.uint32))]
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE), mask=pc.is_null(values))


def filled_int(values: Array) -> Array:
    """Return numbers as int64, with 0 for null."""
    return pc.fill_null(pc.cast(values, arrays.int64(), safe=False), 0)


ONE_ARGUMENT: Mapping[str, Callable[[Array], Array]] = {
    "covariance": _same,
    "variance": _same,
    "positive": _same,
    "coalesce": _same,
    "nan_to_null": _nan,
    "negative": pc.negate,
    "not": pc.invert,
    "sqrt": lambda values: pc.multiply(values, values),
    "exp": pc.ln,
    "log": pc.exp,
    "radians": lambda values: pc.multiply(values, 180 / np.pi),
    "degrees": lambda values: pc.multiply(values, np.pi / 180),
    "quaternion_from_yaw": _yaw,
    "seconds": _from_seconds,
    "nanoseconds": _from_ns,
    "time_from_ns": time_ns,
}
"""Inverses of functions in their first argument, by name. Null stands for the field's own zero."""


def with_constant(name: str, values: Array, number: Any, *, first: bool) -> Array | None:  # noqa: ANN401 - a literal
    """Solve `x name number` (or `number name x` if `first`) for x; None if there is no unique solution."""
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        return None
    if name == "!=" and number == 0:
        return values
    if pt.is_boolean(values.type):
        return None
    solution: dict[tuple[str, bool], Callable[[], Array]] = {
        ("+", False): lambda: pc.subtract(values, number),
        ("+", True): lambda: pc.subtract(values, number),
        ("-", False): lambda: pc.add(values, number),
        ("-", True): lambda: pc.subtract(arrays.scalar(number), values),
        ("*", False): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("*", True): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("/", False): lambda: pc.multiply(values, number),
        ("/", True): lambda: pc.divide(float(number), pc.cast(values, arrays.float64())),
    }
    solve = solution.get((name, first))
    return None if solve is None or (name == "*" and number == 0) else solve()


_STAMP_PARTS = {"seconds": "sec", "nanoseconds": "nanosec"}
_MOVES = frozenset({"ros_time", "ros_header"})
_OPERANDS = 2


class _Scope(Struct, frozen=True):
    """The message in which names are looked up, and the lists that were opened to reach it."""

    path: FieldPath = ()
    axes: tuple[Axis, ...] = ()
    keeps_null: bool = True
    """Whether the field is absent where the value is null; otherwise, it has a value that gives null."""


class ColumnInverter:
    """Assigns the columns of a batch to the fields of its messages."""

    def __init__(self, builder: MessageBuilder, metadata_texts: Mapping[FieldPath, str]) -> None:
        """`metadata_texts` are the fields of the first message that the topic metadata contains."""
        self._builder = builder
        self._is_nullable = builder.presence is not None
        self._metadata_texts = metadata_texts
        self._clouds: list[CloudField] = []
        self._equalities: dict[tuple[FieldPath, int | None, Any], Mask] = {}
        self._target = ""
        self.not_invertible: dict[str, str] = {}
        """Columns that cannot be inverted, with their expressions."""

    def record(self, record: ColumnPlan, rows: Array) -> None:
        """Invert a complete record."""
        self._column(record, rows, _Scope())
        for (path, index, value), where in self._equalities.items():
            self._builder.constrain(path, index, where, value)
        if self._clouds:
            self._builder.assign((), pack_clouds(self._clouds, len(rows)))

    def _column(self, field: ColumnPlan, values: Array, scope: _Scope) -> None:
        self._target = field.path
        absent = null_mask(values)
        if field.when is not None and not _is_presence(field.when):
            scope = replace(scope, keeps_null=False)
            if absent is not None:
                self._make_false(field.when, absent, scope)
        for replaced in field.overrides:
            self._column(replaced, field_of(values, replaced.name), scope)
        self._target = field.path
        match field.source:
            case NullColumn():
                pass
            case ExpressionSource(expression=typed):
                self._expression(typed, values, scope)
            case MapLookup():
                self._map_lookup(field.source, values, scope)
            case NestedAdapter():
                self._adapter(field.source, values, scope)
            case StructSource(operand=of, fields=fields):
                self._fields(of, fields, values, scope)

    def _fields(
        self, of: TypedExpression | None, fields: tuple[ColumnPlan, ...], values: Array, scope: _Scope
    ) -> None:
        inside = (values, scope) if of is None else self._inside(of, values, scope)
        if inside is not None:
            for argument in fields:
                self._column(argument, field_of(inside[0], argument.name), inside[1])

    def _adapter(self, source: NestedAdapter, values: Array, scope: _Scope) -> None:
        inside = self._inside(source.operand, values, scope)
        if inside is None:
            return
        if isinstance(source.adapter, MappingAdapter):
            self._column(source.adapter.record, *inside)
        else:
            self._report_not_invertible(f"{source.name} of {source.operand.text}")

    def _inside(self, of: TypedExpression, values: Array, scope: _Scope) -> tuple[Array, _Scope] | None:
        path = _field_path(of, scope)
        if path is None:
            self._report_not_invertible(of.text)
            return None
        values, axes = _opened(of, values)
        return values, _Scope(path, (*scope.axes, *axes), scope.keeps_null)

    def _map_lookup(self, source: MapLookup, values: Array, scope: _Scope) -> None:
        values, axes = _opened(source.operand, values)
        index = pc.index_in(values, value_set=pc.cast(source.values, values.type))
        originals = source.keys.take(index)
        if source.otherwise == source.operand and originals.type != values.type:
            originals = pc.cast(originals, values.type)
        if source.otherwise == source.operand:
            originals = pc.coalesce(originals, values)
        self._assign(source.operand, originals, _Scope(scope.path, (*scope.axes, *axes), keeps_null=False))

    def _expression(self, typed: TypedExpression, values: Array, scope: _Scope) -> None:
        values, axes = _opened(typed, values)
        keeps_null = scope.keeps_null and values.type != HEADER_TYPE  # an empty header is stored as null, too
        self._assign(typed, values, _Scope(scope.path, (*scope.axes, *axes), keeps_null))

    def _assign(self, typed: TypedExpression, values: Array, scope: _Scope) -> None:
        """Assign the values of an expression to the fields it reads; one value per element of all open lists."""
        path = _field_path(typed, scope)
        if path is not None:
            if path.count(EACH_ELEMENT) != len(scope.axes):
                self._report_not_invertible(typed.text)
            else:
                self._builder.assign(path, values, scope.axes, keeps_null=scope.keeps_null)
            return
        match typed:
            case Constant() | EnvelopeField():
                pass
            case Cast(operand=of):
                self._assign(of, values, scope)
            case MakeList(items=items):
                for position, item in enumerate(items):
                    self._assign(item, _element(values, position), scope)
            case ElementAt():
                self._item(typed, values, scope)
            case Conditional():
                self._choice(typed, values, scope)
            case FunctionCall():
                self._apply(typed, values, scope)
            case _:
                self._report_not_invertible(typed.text)

    def _item(self, typed: ElementAt, values: Array, scope: _Scope) -> None:
        """Assign one number to its element of a fixed-size list."""
        location = _element_path(typed, scope)
        if location is None or not is_number(values.type):
            self._report_not_invertible(typed.text)
        else:
            present = np.asarray(values.is_valid())
            self._builder.constrain(*location, present, np.asarray(pc.fill_null(values, 0)))

    def _apply(self, typed: FunctionCall, values: Array, scope: _Scope) -> None:
        first = typed.arguments[0]
        if typed.name in CLOUD_FUNCTIONS and not scope.axes and isinstance(typed.arguments[1], Constant):
            self._clouds.append(CloudField(str(typed.arguments[1].value), typed.name, values))
        elif typed.name == "coalesce" and self._is_nullable and isinstance(typed.arguments[-1], Constant):
            self._assign(first, _null_if(values, typed.arguments[-1].value), scope)
        elif typed.name == "nan_to_null" and self._is_nullable:
            self._assign(first, values, scope)
        elif typed.name == "empty_to_null":
            self._assign(first, values, replace(scope, keeps_null=False))
        elif typed.name in ONE_ARGUMENT:
            self._assign(first, ONE_ARGUMENT[typed.name](values), scope)
        elif typed.name == "compressed_format":
            self._assign(
                first, self._explained_by_metadata(first, values, scope, typed.function.apply), scope
            )
        elif typed.name == "null_if" and isinstance(typed.arguments[1], Constant):
            value = arrays.scalar(typed.arguments[1].value).cast(values.type)
            self._assign(first, pc.fill_null(values, value), replace(scope, keeps_null=False))
        elif typed.name in {"min", "max", "clip"}:
            self._assign(self._argument_named_like_column(typed), values, scope)
        else:
            self._operator(typed, values, scope)

    def _operator(self, typed: FunctionCall, values: Array, scope: _Scope) -> None:
        """Invert an operator with one literal operand, such as `x + 1` or `1 + x`."""
        if len(typed.arguments) != _OPERANDS:
            self._report_not_invertible(typed.text)
            return
        left, right = typed.arguments
        if isinstance(right, Constant):
            solution, unknown = with_constant(typed.name, values, right.value, first=False), left
        elif isinstance(left, Constant):
            solution, unknown = with_constant(typed.name, values, left.value, first=True), right
        else:
            solution, unknown = None, left
        if solution is None:
            self._report_not_invertible(typed.text)
        else:
            self._assign(unknown, solution, scope)

    def _argument_named_like_column(self, typed: FunctionCall) -> TypedExpression:
        """Return the argument with the name of the column, else the first."""
        name = self._target.rpartition(".")[2]
        location = (
            argument
            for argument in typed.arguments
            if isinstance(argument, FieldAccess) and argument.name == name
        )
        return next(location, typed.arguments[0])

    def _explained_by_metadata(
        self, typed: TypedExpression, values: Array, scope: _Scope, function: Callable[[Array], Array]
    ) -> Array:
        """Use the text of the topic metadata in the rows that it explains."""
        metadata_text = self._metadata_texts.get(_field_path(typed, scope) or ())
        if metadata_text is None:
            return values
        stored_value = function(arrays.array([metadata_text]))[0]
        return pc.if_else(pc.equal(values, stored_value), arrays.scalar(metadata_text), values)

    def _choice(self, typed: Conditional, values: Array, scope: _Scope) -> None:
        if isinstance(typed.then, Constant):
            missing = typed.then.value
            nan = isinstance(missing, float) and math.isnan(missing)
            if nan:
                self._make_true(typed.condition, true_mask(pc.is_nan(values)), scope)
            elif missing is not None:
                self._report_not_invertible(typed.text)
            self._assign(typed.otherwise, values, scope)
        elif isinstance(typed.otherwise, Constant):
            self._assign(typed.then, values, scope)
        else:
            self._report_not_invertible(typed.text)

    def _make_true(self, condition: TypedExpression, where: Mask, scope: _Scope) -> None:
        """Make `a == 1` true in some rows, unless other columns of the same field contradict it."""
        match condition:
            case FunctionCall(name="==", arguments=(value, Constant(value=constant))):
                location = _element_path(value, scope)
                if location is not None:
                    key = (*location, constant)
                    self._equalities[key] = where & self._equalities.get(key, where)
            case _:
                pass

    def _make_false(self, condition: TypedExpression, where: Mask, scope: _Scope) -> None:
        """Make a condition false in some rows if possible; for many conditions, the default zero does."""
        match condition:
            case FunctionCall(name="!=", arguments=(value, Constant(value=constant))):
                self._mark(value, where, constant, scope)
            case FunctionCall(name=">=", arguments=(value, Constant(value=int(constant)))) if constant <= 0:
                self._mark(value, where, constant - 1, scope)
            case FunctionCall(name="or", arguments=conditions):
                for argument in conditions:
                    self._make_false(argument, where, scope)
            case _:
                pass

    def _mark(self, typed: TypedExpression, where: Mask, value: Any, scope: _Scope) -> None:  # noqa: ANN401 - a literal
        location = _element_path(typed, scope)
        if location is not None:
            self._builder.constrain(*location, where, value)

    def _report_not_invertible(self, text: str) -> None:
        self.not_invertible.setdefault(self._target, text)


def _is_presence(condition: TypedExpression) -> bool:
    """Return whether a condition is that a field is present, as in `not is_null(velocity.x)`."""
    match condition:
        case FunctionCall(name="not", arguments=(FunctionCall(name="is_null", arguments=(FieldAccess(),)),)):
            return True
        case _:
            return False


def _null_if(values: Array, value: LiteralValue) -> Array:
    """Return the values with null in place of one value, which can be NaN."""
    is_nan = isinstance(value, float) and math.isnan(value)
    where = pc.is_nan(values) if is_nan else pc.equal(values, value)
    return pc.if_else(where, arrays.scalar(None, values.type), values)


def _field_path(typed: TypedExpression, scope: _Scope) -> FieldPath | None:
    """Return the field that an expression reads, None if it computes a value."""
    match typed:
        case MessageRef():
            return scope.path
        case FieldAccess(operand=FunctionCall(name="ros_time", arguments=(of,)), name=name):
            inner = _field_path(of, scope)
            return None if inner is None else (*inner, _STAMP_PARTS[name])
        case FieldAccess(operand=of, name=name):
            inner = _field_path(of, scope)
            return None if inner is None else (*inner, name)
        case OpenList(operand=of):
            inner = _field_path(of, scope)
            return None if inner is None else (*inner, EACH_ELEMENT)
        case FunctionCall(name=name, arguments=(of,)) if name in _MOVES:
            return _field_path(of, scope)
        case _:
            return None


def _element_path(typed: TypedExpression, scope: _Scope) -> tuple[FieldPath, int | None] | None:
    """Return the field that an expression reads and the index of its element, None if it computes a value."""
    index = typed.index if isinstance(typed, ElementAt) else None
    path = _field_path(typed.operand if isinstance(typed, ElementAt) else typed, scope)
    if path is None or path.count(EACH_ELEMENT) != len(scope.axes) or (index is not None and index < 0):
        return None
    return path, index


def _opened(typed: TypedExpression, values: Array) -> tuple[Array, tuple[Axis, ...]]:
    """Open the lists of a column that its expression opened."""
    axes: list[Axis] = []
    for _ in typed.type.axes:
        values, axis = open_list(values)
        axes.append(axis)
    return values, tuple(axes)


def _element(lists: Array, position: int) -> Array:
    """Return one element of every list, null if the list is too short."""
    elements, axis = open_list(lists)
    is_present = axis.lengths > position
    at = np.where(is_present, axis.offsets[:-1] + position, 0)
    if pt.is_null(elements.type) or not len(elements):
        return arrays.nulls(len(lists), elements.type)
    return elements.take(arrays.array(at, mask=~is_present))
