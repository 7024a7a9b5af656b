"""The static types of expressions, and the rules that combine them."""

from __future__ import annotations

import pyarrow as pa
from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.mapping.columns import DataType, arrays, pt

Bounds = tuple[int, int]
INT64 = (-(2**63), 2**63 - 1)
_FLOATS = (pa.float16(), pa.float32(), pa.float64())
_EXACT_INTEGERS = (2**11, 2**24, 2**53)
"""Magnitude up to which each of the floats represents every integer exactly."""


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
