"""Invert a compiled mapping: assign column values to the message fields they came from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from msgspec import Struct

from mosaico_ingest.adapters.inverse.message_builder import (
    CLOUD_FUNCTIONS,
    EACH_ELEMENT,
    CloudField,
    FieldPath,
    MessageBuilder,
    pack_clouds,
)
from mosaico_ingest.adapters.mapping.column_plan import (
    ColumnPlan,
    ExpressionSource,
    MapLookup,
    NestedAdapter,
    NullColumn,
    StructSource,
)
from mosaico_ingest.adapters.mapping.columns import (
    Array,
    Axis,
    Mask,
    arrays,
    field_of,
    null_mask,
    open_list,
    pc,
    pt,
    true_mask,
)
from mosaico_ingest.adapters.mapping.expressions import (
    Cast,
    Conditional,
    Constant,
    ElementAt,
    FieldAccess,
    FunctionCall,
    MakeList,
    MessageRef,
    OpenList,
    TypedExpression,
)
from mosaico_ingest.adapters.mapping.functions.ros import STAMP_TYPE
from mosaico_ingest.adapters.mapping.loader import MappingAdapter
from mosaico_ingest.adapters.mapping.types import is_number

__all__ = [
    "ONE_ARGUMENT",
    "ColumnInverter",
    "with_constant",
]

_SECOND_NS = 1_000_000_000


def _same(values: Array) -> Array:
    return values


def _nan(values: Array) -> Array:
    return pc.fill_null(values, arrays.scalar(float("nan"), values.type))


def _yaw(quaternion: Array) -> Array:
    x, y, z, w = (np.asarray(field_of(quaternion, name).fill_null(0.0)) for name in "xyzw")
    return arrays.array(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _from_seconds(values: Array) -> Array:
    return _from_ns(pc.round(pc.multiply(values, float(_SECOND_NS))))


def _from_ns(values: Array) -> Array:
    whole = np.asarray(filled_int(values))
    seconds, rest = np.divmod(whole, _SECOND_NS)
    children = [arrays.array(seconds.astype(np.int32)), arrays.array(rest.astype(np.uint32))]
    return arrays.StructArray.from_arrays(children, fields=list(STAMP_TYPE))


def _to_ns(values: Array) -> Array:
    seconds, rest = (pc.cast(field_of(values, name), arrays.int64()) for name in ("seconds", "nanoseconds"))
    return pc.add(pc.multiply(seconds, _SECOND_NS), rest)


def filled_int(values: Array) -> Array:
    """Return numbers as int64, 0 where there is none."""
    return pc.fill_null(pc.cast(values, arrays.int64(), safe=False), 0)


ONE_ARGUMENT: Mapping[str, Callable[[Array], Array]] = {
    "covariance": _same,
    "variance": _same,
    "empty_to_null": _same,
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
    "time_from_ns": _to_ns,
}
"""By the function's name: what its (first) argument was. A null stands for the field's own zero."""


def with_constant(name: str, values: Array, number: Any, *, first: bool) -> Array | None:  # noqa: ANN401 - a literal
    """Return x of `x name number` (`first`: of `number name x`) where that gave `values`; None where it cannot be."""
    if isinstance(number, bool) or not isinstance(number, (int, float)):
        return None
    if name == "!=" and number == 0:
        return values
    if pt.is_boolean(values.type):
        return None
    solved: dict[tuple[str, bool], Callable[[], Array]] = {
        ("+", False): lambda: pc.subtract(values, number),
        ("+", True): lambda: pc.subtract(values, number),
        ("-", False): lambda: pc.add(values, number),
        ("-", True): lambda: pc.subtract(arrays.scalar(number), values),
        ("*", False): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("*", True): lambda: pc.divide(pc.cast(values, arrays.float64()), float(number)),
        ("/", False): lambda: pc.multiply(values, number),
        ("/", True): lambda: pc.divide(float(number), pc.cast(values, arrays.float64())),
    }
    solve = solved.get((name, first))
    return None if solve is None or (name == "*" and number == 0) else solve()


_STAMP_PARTS = {"seconds": "sec", "nanoseconds": "nanosec"}
_MOVES = frozenset({"ros_time", "ros_header"})
_OPERANDS = 2


class _Scope(Struct, frozen=True):
    """Where names are looked up, and the lists that were opened on the way there."""

    place: FieldPath = ()
    axes: tuple[Axis, ...] = ()


class ColumnInverter:
    """Puts the columns of a batch back into the fields of its messages."""

    def __init__(self, parts: MessageBuilder, said: Mapping[FieldPath, str]) -> None:
        """`said` is what the topic's metadata keeps of the first message."""
        self._parts = parts
        self._said = said
        self._clouds: list[CloudField] = []
        self._held: dict[tuple[FieldPath, int | None, Any], Mask] = {}
        self._target = ""
        self.not_invertible: dict[str, str] = {}
        """Columns that could not be undone, and what they are computed as."""

    def record(self, record: ColumnPlan, rows: Array) -> None:
        """Invert a whole record."""
        self._column(record, rows, _Scope())
        for (place, index, value), where in self._held.items():
            self._parts.constrain(place, index, where, value)
        if self._clouds:
            self._parts.assign((), pack_clouds(self._clouds, len(rows)))

    def _column(self, field: ColumnPlan, values: Array, scope: _Scope) -> None:
        self._target = field.path
        absent = null_mask(values)
        if field.when is not None and absent is not None:
            self._fails(field.when, absent, scope)
        for replaced in field.overrides:
            self._column(replaced, field_of(values, replaced.name), scope)
        self._target = field.path
        match field.source:
            case NullColumn():
                pass
            case ExpressionSource(expression=typed):
                self._expression(typed, values, scope)
            case MapLookup():
                self._looked(field.source, values, scope)
            case NestedAdapter():
                self._adapter(field.source, values, scope)
            case StructSource(operand=of, fields=fields):
                self._fields(of, fields, values, scope)

    def _fields(
        self, of: TypedExpression | None, fields: tuple[ColumnPlan, ...], values: Array, scope: _Scope
    ) -> None:
        inside = (values, scope) if of is None else self._inside(of, values, scope)
        if inside is not None:
            for one in fields:
                self._column(one, field_of(inside[0], one.name), inside[1])

    def _adapter(self, source: NestedAdapter, values: Array, scope: _Scope) -> None:
        inside = self._inside(source.operand, values, scope)
        if inside is None:
            return
        if isinstance(source.adapter, MappingAdapter):
            self._column(source.adapter.record, *inside)
        else:
            self._give_up(f"{source.name} of {source.operand.text}")

    def _inside(self, of: TypedExpression, values: Array, scope: _Scope) -> tuple[Array, _Scope] | None:
        place = _place(of, scope)
        if place is None:
            self._give_up(of.text)
            return None
        values, axes = _opened(of, values)
        return values, _Scope(place, (*scope.axes, *axes))

    def _looked(self, source: MapLookup, values: Array, scope: _Scope) -> None:
        values, axes = _opened(source.operand, values)
        index = pc.index_in(values, value_set=pc.cast(source.values, values.type))
        found = source.keys.take(index)
        if source.otherwise == source.operand and found.type != values.type:
            found = pc.cast(found, values.type)
        if source.otherwise == source.operand:
            found = pc.coalesce(found, values)
        self._assign(source.operand, found, _Scope(scope.place, (*scope.axes, *axes)))

    def _expression(self, typed: TypedExpression, values: Array, scope: _Scope) -> None:
        values, axes = _opened(typed, values)
        self._assign(typed, values, _Scope(scope.place, (*scope.axes, *axes)))

    def _assign(self, typed: TypedExpression, values: Array, scope: _Scope) -> None:
        """Say what an expression's fields were, given what it came to, one value an element of all open lists."""
        place = _place(typed, scope)
        if place is not None:
            if place.count(EACH_ELEMENT) != len(scope.axes):
                self._give_up(typed.text)
            else:
                self._parts.assign(place, values, scope.axes)
            return
        match typed:
            case Constant():
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
                self._give_up(typed.text)

    def _item(self, typed: ElementAt, values: Array, scope: _Scope) -> None:
        """Put one number into its list, which is as long as its type says."""
        named = _marked_place(typed, scope)
        if named is None or not is_number(values.type):
            self._give_up(typed.text)
        else:
            present = np.asarray(values.is_valid())
            self._parts.constrain(*named, present, np.asarray(pc.fill_null(values, 0)))

    def _apply(self, typed: FunctionCall, values: Array, scope: _Scope) -> None:
        first = typed.arguments[0]
        if typed.name in CLOUD_FUNCTIONS and not scope.axes and isinstance(typed.arguments[1], Constant):
            self._clouds.append(CloudField(str(typed.arguments[1].value), typed.name, values))
        elif typed.name in ONE_ARGUMENT:
            self._assign(first, ONE_ARGUMENT[typed.name](values), scope)
        elif typed.name == "compressed_format":
            self._assign(first, self._as_said(first, values, scope, typed.function.apply), scope)
        elif typed.name == "null_if" and isinstance(typed.arguments[1], Constant):
            value = arrays.scalar(typed.arguments[1].value).cast(values.type)
            self._assign(first, pc.fill_null(values, value), scope)
        elif typed.name in {"min", "max", "clip"}:
            self._assign(self._namesake(typed), values, scope)
        else:
            self._operator(typed, values, scope)

    def _operator(self, typed: FunctionCall, values: Array, scope: _Scope) -> None:
        """Undo `x + 1` and `1 + x`; one side is a literal."""
        if len(typed.arguments) != _OPERANDS:
            self._give_up(typed.text)
            return
        left, right = typed.arguments
        if isinstance(right, Constant):
            solved, unknown = with_constant(typed.name, values, right.value, first=False), left
        elif isinstance(left, Constant):
            solved, unknown = with_constant(typed.name, values, left.value, first=True), right
        else:
            solved, unknown = None, left
        if solved is None:
            self._give_up(typed.text)
        else:
            self._assign(unknown, solved, scope)

    def _namesake(self, typed: FunctionCall) -> TypedExpression:
        """Return the argument that is called like the column; the first where none is."""
        name = self._target.rpartition(".")[2]
        named = (one for one in typed.arguments if isinstance(one, FieldAccess) and one.name == name)
        return next(named, typed.arguments[0])

    def _as_said(
        self, typed: TypedExpression, values: Array, scope: _Scope, function: Callable[[Array], Array]
    ) -> Array:
        """Take the text of the topic's metadata in the rows it explains."""
        said = self._said.get(_place(typed, scope) or ())
        if said is None:
            return values
        gives = function(arrays.array([said]))[0]
        return pc.if_else(pc.equal(values, gives), arrays.scalar(said), values)

    def _choice(self, typed: Conditional, values: Array, scope: _Scope) -> None:
        if isinstance(typed.then, Constant):
            missing = typed.then.value
            nan = isinstance(missing, float) and math.isnan(missing)
            if nan:
                self._holds(typed.condition, true_mask(pc.is_nan(values)), scope)
            elif missing is not None:
                self._give_up(typed.text)
            self._assign(typed.otherwise, values, scope)
        elif isinstance(typed.otherwise, Constant):
            self._assign(typed.then, values, scope)
        else:
            self._give_up(typed.text)

    def _holds(self, condition: TypedExpression, where: Mask, scope: _Scope) -> None:
        """Make `a == 1` true in some rows, unless other columns that depend on it show that it was not."""
        match condition:
            case FunctionCall(name="==", arguments=(value, Constant(value=constant))):
                named = _marked_place(value, scope)
                if named is not None:
                    key = (*named, constant)
                    self._held[key] = where & self._held.get(key, where)
            case _:
                pass

    def _fails(self, condition: TypedExpression, where: Mask, scope: _Scope) -> None:
        """Make a condition false in some rows, where one can see how; zero does it for many."""
        match condition:
            case FunctionCall(name="!=", arguments=(value, Constant(value=constant))):
                self._mark(value, where, constant, scope)
            case FunctionCall(name=">=", arguments=(value, Constant(value=int(constant)))) if constant <= 0:
                self._mark(value, where, constant - 1, scope)
            case FunctionCall(name="or", arguments=both):
                for one in both:
                    self._fails(one, where, scope)
            case _:
                pass

    def _mark(self, typed: TypedExpression, where: Mask, value: Any, scope: _Scope) -> None:  # noqa: ANN401 - a literal
        named = _marked_place(typed, scope)
        if named is not None:
            self._parts.constrain(*named, where, value)

    def _give_up(self, text: str) -> None:
        self.not_invertible.setdefault(self._target, text)


def _place(typed: TypedExpression, scope: _Scope) -> FieldPath | None:
    """Return the field an expression names; None where it computes something."""
    match typed:
        case MessageRef():
            return scope.place
        case FieldAccess(operand=FunctionCall(name="ros_time", arguments=(of,)), name=name):
            inner = _place(of, scope)
            return None if inner is None else (*inner, _STAMP_PARTS[name])
        case FieldAccess(operand=of, name=name):
            inner = _place(of, scope)
            return None if inner is None else (*inner, name)
        case OpenList(operand=of):
            inner = _place(of, scope)
            return None if inner is None else (*inner, EACH_ELEMENT)
        case FunctionCall(name=name, arguments=(of,)) if name in _MOVES:
            return _place(of, scope)
        case _:
            return None


def _marked_place(typed: TypedExpression, scope: _Scope) -> tuple[FieldPath, int | None] | None:
    """Return the field an expression names, and which element of it; None where it computes something."""
    index = typed.index if isinstance(typed, ElementAt) else None
    place = _place(typed.operand if isinstance(typed, ElementAt) else typed, scope)
    if place is None or place.count(EACH_ELEMENT) != len(scope.axes) or (index is not None and index < 0):
        return None
    return place, index


def _opened(typed: TypedExpression, values: Array) -> tuple[Array, tuple[Axis, ...]]:
    """Open the lists of a column that the expression made."""
    axes: list[Axis] = []
    for _ in typed.type.axes:
        values, axis = open_list(values)
        axes.append(axis)
    return values, tuple(axes)


def _element(lists: Array, position: int) -> Array:
    """Return one element of every list, null where there is none."""
    elements, axis = open_list(lists)
    there = axis.lengths > position
    at = np.where(there, axis.offsets[:-1] + position, 0)
    if pt.is_null(elements.type) or not len(elements):
        return arrays.nulls(len(lists), elements.type)
    return elements.take(arrays.array(at, mask=~there))
