"""The values of expressions: flat Arrow arrays with the offsets of their open lists, and static types."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.types
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

Array: TypeAlias = Any
"""A `pyarrow.Array`; its type follows from the expression."""
Scalar: TypeAlias = Any
DataType: TypeAlias = Any
pc: Any = pyarrow.compute
pt: Any = pyarrow.types
arrays: Any = pa
"""pyarrow without its stubs, which are narrower than the constructors."""
Mask = NDArray[np.bool_]
SECOND_NS = 1_000_000_000
Bounds = tuple[int, int]
INT64 = (-(2**63), 2**63 - 1)
_FLOATS = (pa.float16(), pa.float32(), pa.float64())
_EXACT_INTEGERS = (2**11, 2**24, 2**53)
"""Magnitude up to which each of the floats represents every integer exactly."""


class Axis(Struct, frozen=True, eq=False):
    """One level of lists: how consecutive elements form n rows.

    Offsets start at 0. A null row has no elements, except in fixed-size lists, where its elements exist and are unused.
    """

    offsets: NDArray[np.int64]
    """Start of each row's elements and the end of the last, shape (n + 1,)."""
    null: Mask | None
    """True where the list itself is null, shape (n,)."""
    size: int | None
    """The length of every row of a fixed-size list."""

    @property
    def lengths(self) -> NDArray[np.int64]:
        """The number of elements of each row, shape (n,)."""
        return np.diff(self.offsets)

    @property
    def parents(self) -> NDArray[np.int64]:
        """The row of each element, shape (elements,)."""
        return np.repeat(np.arange(len(self.offsets) - 1), self.lengths)

    def matches(self, other: Axis) -> bool:
        """Return whether both axes divide their elements in the same way."""
        return self is other or np.array_equal(self.offsets, other.offsets)

    def close(self, values: Array, type_: DataType = None) -> Array:
        """Build the list column of the elements `values`, without copying them."""
        size = self.size if type_ is None or pt.is_fixed_size_list(type_) else None
        if size is not None:
            return fixed_list(values, size, self.null, len(self.offsets) - 1, type_)
        return variable_list(values, self.offsets, self.null, type_)


class Column(Struct, frozen=True, eq=False):
    """The values of the innermost elements, or one value per row without axes. A literal stays an Arrow scalar."""

    values: Array | Scalar
    axes: tuple[Axis, ...] = ()

    def array(self, rows: int) -> Array:
        """Return the values as an array; a literal is repeated `rows` times."""
        if isinstance(self.values, pa.Scalar):
            return repeat(self.values, rows)
        return self.values

    def close_all(self, rows: int) -> Array:
        """Return one value per row, with all lists closed."""
        values = self.array(rows)
        for axis in reversed(self.axes):
            values = axis.close(values)
        return values

    def close_innermost(self) -> Column:
        """Return the column after its innermost list is closed."""
        return Column(self.axes[-1].close(self.array(0)), self.axes[:-1])

    def broadcast_to(self, axes: tuple[Axis, ...]) -> Column:
        """Repeat the values for the elements of further axes; literals stay scalars."""
        values = self.values
        if isinstance(values, pa.Array):
            for axis in axes[len(self.axes) :]:
                values = values.take(arrays.array(axis.parents))
        return Column(values, axes)


def repeat(scalar: Scalar, length: int) -> Array:
    """Return an array that holds one scalar `length` times."""
    return arrays.repeat(scalar, length) if scalar.is_valid else arrays.nulls(length, scalar.type)


def null_mask(array: Array) -> Mask | None:
    """Return where an array is null, or None if it has no nulls."""
    return np.asarray(array.is_null()) if array.null_count else None


def true_mask(values: Array | Scalar, *, null: bool = False) -> Mask:
    """Return where a boolean column is true, with nulls counted as `null`; shape (1,) for a scalar."""
    if isinstance(values, pa.Scalar):
        return np.array([values.as_py() if values.is_valid else null])
    booleans = pc.fill_null(values, null) if values.null_count else values
    trues = booleans.true_count
    if trues in {0, len(booleans)}:
        return np.full(len(booleans), trues > 0)
    return np.asarray(booleans)


def field_of(rows: Array, name: str) -> Array:
    """Return a field of every row, null where the row is null; shares memory unless a row is null."""
    position = rows.type.get_field_index(name)
    return pc.struct_field(rows, [position]) if rows.null_count else rows.field(position)


def time_ns(times: Array, parts: tuple[str, str] | None = None) -> Array:
    """Return times in nanoseconds, null where a part is null.

    `parts` names the seconds and the nanoseconds; by default, these are the first and the second field.
    """
    names = parts or tuple(field.name for field in times.type)
    seconds, rest = (pc.cast(field_of(times, name), arrays.int64()) for name in names)
    return pc.add(pc.multiply(seconds, SECOND_NS), rest)


def open_list(array: Array) -> tuple[Array, Axis]:
    """Return the elements of a list column and the axis that divides them into rows."""
    null = null_mask(array)
    if pt.is_fixed_size_list(array.type):
        size = array.type.list_size
        values = array.values.slice(array.offset * size, len(array) * size)
        return values, Axis(np.arange(len(array) + 1, dtype=np.int64) * size, null, size)
    lengths = np.asarray(pc.fill_null(pc.list_value_length(array), 0)).astype(np.int64)
    offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(lengths)))
    return array.flatten(), Axis(offsets, null, None)


def variable_list(
    values: Array, offsets: NDArray[np.int64], null: Mask | None, type_: DataType = None
) -> Array:
    """Build a list column over `values`."""
    mask = None if null is None else arrays.array(null)
    starts = arrays.array(offsets.astype(np.int32))
    return arrays.ListArray.from_arrays(starts, values, type=type_ or arrays.list_(values.type), mask=mask)


def fixed_list(values: Array, size: int, null: Mask | None, rows: int, type_: DataType = None) -> Array:
    """Build a fixed-size list column over `values`."""
    type_ = type_ or arrays.list_(values.type, size)
    if size == 0:
        return arrays.array([[]] * rows, type_)
    mask = None if null is None else arrays.array(null)
    return arrays.FixedSizeListArray.from_arrays(values, type=type_, mask=mask)


def struct_of(children: list[Array], type_: DataType, null: Mask | None, rows: int) -> Array:
    """Build a struct column; `rows` is the length of a struct without fields."""
    if not children:
        empty = [{}] * rows if null is None else [None if absent else {} for absent in null]
        return arrays.array(empty, type_)
    mask = None if null is None or not null.any() else arrays.array(null)
    return arrays.StructArray.from_arrays(children, fields=list(type_), mask=mask)


def null_where(array: Array, mask: Mask) -> Array:
    """Return the array with nulls where `mask` is true; struct fields keep their values, so nothing is copied."""
    if not mask.any():
        return array
    nulls = null_mask(array)
    null = mask if nulls is None else mask | nulls
    if pt.is_struct(array.type):
        children = [array.field(i) for i in range(array.type.num_fields)]
        return struct_of(children, array.type, null, len(array))
    return arrays.array(pc.if_else(arrays.array(null), arrays.scalar(None, array.type), array))


def promote(*values: Array) -> list[Array]:
    """Cast arrays or scalars to a common type; the checker guarantees that there is one."""
    types = [v.type for v in values if not pt.is_null(v.type)]
    if not types:
        return list(values)
    both = types[0]
    if any(t != both for t in types) and not pt.is_nested(both):
        whole = arrays.uint64() if arrays.uint64() in types else arrays.int64()
        both = arrays.float64() if any(pt.is_floating(t) for t in types) else whole
    return [_in_type(v, both) for v in values]


def _in_type(values: Array, type_: DataType) -> Array:
    if values.type == type_:
        return values
    if pt.is_null(values.type):
        scalar = isinstance(values, pa.Scalar)
        return arrays.scalar(None, type_) if scalar else arrays.nulls(len(values), type_)
    return pc.cast(values, type_, safe=False)


class TypeMismatch(Exception):  # noqa: N818 - a condition of two types, turned into a finding by the checker
    """Two types are incompatible; `argument` is the position of the offending argument, if known."""

    def __init__(self, message: str, *, argument: int | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        self.argument = argument
        self.hint = hint


class ExprType(Struct, frozen=True):
    """The static type of an expression.

    For a computed float, `arrow` is the widest float field among its operands: results are computed in 64 bits, and the
    width only decides which columns they fit.
    """

    arrow: DataType
    axes: tuple[int | None, ...] = ()
    """The open lists, outermost first: the length of a fixed-size list, None for a list of any length."""
    bounds: Bounds | None = None
    """The smallest and largest possible value of an integer; None for any other type."""
    msgtype: str | None = None
    """The message type of a struct, or of the structs in a list."""

    @property
    def element(self) -> ExprType:
        """The type of one element, without the open lists."""
        return replace(self, axes=())

    def close_innermost(self) -> ExprType:
        """Return the type after the innermost open list is closed."""
        inner = expr_type_of(list_type(self.arrow, self.axes[-1]), msgtype=self.msgtype)
        return replace(inner, axes=self.axes[:-1])

    def close_all(self) -> ExprType:
        """Return the type after all lists are closed: the type of the complete column."""
        expr_type = self
        while expr_type.axes:
            expr_type = expr_type.close_innermost()
        return expr_type


def expr_type_of(type_: DataType, *, msgtype: str | None = None) -> ExprType:
    """Return the expression type of a column of an Arrow type."""
    return ExprType(type_, bounds=int_bounds(type_), msgtype=msgtype)


def list_type(type_: DataType, size: int | None) -> DataType:
    """Return the type of lists of `type_`, of a fixed length if `size` is given."""
    return arrays.list_(type_) if size is None else arrays.list_(type_, size)


def int_bounds(type_: DataType) -> Bounds | None:
    """Return the smallest and largest value of an integer type, None for any other type."""
    if not pt.is_integer(type_):
        return None
    bits = type_.bit_width
    return (0, 2**bits - 1) if pt.is_unsigned_integer(type_) else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def is_list(type_: DataType) -> bool:
    """Return whether `type_` is a list, of fixed length or not."""
    return pt.is_list(type_) or pt.is_fixed_size_list(type_)


def is_number(type_: DataType) -> bool:
    """Return whether `type_` is an integer or a float; bool is not a number."""
    return pt.is_integer(type_) or pt.is_floating(type_)


def exact_float(expr_type: ExprType) -> DataType:
    """Return the narrowest float type that represents every value of a numeric type exactly."""
    if expr_type.bounds is None:
        return expr_type.arrow
    reach = max(abs(expr_type.bounds[0]), abs(expr_type.bounds[1]))
    fitting = (float_ for float_, exact in zip(_FLOATS, _EXACT_INTEGERS, strict=True) if reach <= exact)
    return next(fitting, _FLOATS[-1])


def widest_float(*types: DataType) -> DataType:
    """Return the widest float type among `types`, or float16 if there is none."""
    return max((t for t in types if pt.is_floating(t)), key=lambda t: t.bit_width, default=_FLOATS[0])


def common_type(expr_types: list[ExprType]) -> ExprType:
    """Return the element type of a value that is one of several values; open lists are ignored.

    Raises:
        TypeMismatch: The types have nothing in common.
    """
    first = next((expr_type for expr_type in expr_types if not pt.is_null(expr_type.arrow)), expr_types[0])
    types = [expr_type for expr_type in expr_types if not pt.is_null(expr_type.arrow)] or [first]
    if all(is_number(expr_type.arrow) for expr_type in types):
        return _join_numbers(types)
    for position, expr_type in enumerate(expr_types):
        if not pt.is_null(expr_type.arrow) and expr_type.arrow != first.arrow:
            raise TypeMismatch(
                f"{format_type(first)} and {format_type(expr_type)} have no common type", argument=position
            )
    return first.element


def _join_numbers(expr_types: list[ExprType]) -> ExprType:
    bounds = [expr_type.bounds for expr_type in expr_types if expr_type.bounds is not None]
    if len(bounds) < len(expr_types):
        return ExprType(widest_float(*(exact_float(expr_type) for expr_type in expr_types)))
    low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
    if high > INT64[1] and low < 0:
        raise TypeMismatch(
            "uint64 and a possibly negative integer have no common type", hint="cast one of them"
        )
    same = all(expr_type.arrow == expr_types[0].arrow for expr_type in expr_types)
    common = arrays.int64() if high <= INT64[1] else arrays.uint64()
    return ExprType(expr_types[0].arrow if same else common, bounds=(low, high))


def format_type(expr_type: ExprType | DataType) -> str:
    """Return a type as the language spells it; nested structs show only their field names."""
    if isinstance(expr_type, pa.DataType):
        return _spell_type(expr_type)
    closed = expr_type.close_all()
    if closed.msgtype is not None:
        depth, type_ = 0, closed.arrow
        while pt.is_list(type_) or pt.is_fixed_size_list(type_):
            depth, type_ = depth + 1, type_.value_type
        return f"{closed.msgtype}{'[]' * depth}"
    return _spell_type(closed.arrow)


def _spell_type(type_: DataType) -> str:
    if pt.is_fixed_size_list(type_):
        return f"list[{_spell_type(type_.value_type)}, {type_.list_size}]"
    if pt.is_list(type_):
        return f"list[{_spell_type(type_.value_type)}]"
    if pt.is_struct(type_):
        return "{" + ", ".join(field.name for field in type_) + "}"
    return {"double": "float64", "float": "float32", "halffloat": "float16"}.get(str(type_), str(type_))


def narrowest_int(bounds: Bounds) -> DataType:
    """Return the narrowest integer type for all values within bounds, preferring signed types."""
    names = [f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u")]
    types: list[DataType] = [getattr(arrays, name)() for name in names]
    return next((t for t in types if within(bounds, int_bounds(t))), arrays.int64())


def within(bounds: Bounds, outer: Bounds | None) -> bool:
    """Return whether `bounds` lies within `outer`."""
    return outer is not None and outer[0] <= bounds[0] and bounds[1] <= outer[1]
