"""The measurement of message fields for a drafted contract: few expressions per topic, with the range of their values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct
from numpy.typing import NDArray

from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.adapters.mapping.types import is_number
from mosaico_ingest.contracts.expressions import Evaluator, FieldExpression, bind_expression, message_rows
from mosaico_ingest.contracts.values import Values
from mosaico_ingest.rosbag.definitions.model import Definition, Language

MAX_FIELDS = 8
"""Maximum number of expressions per topic, in the order of the message definition."""
_VECTORS = ({"x", "y"}, {"x", "y", "z"})
_QUATERNION = {"x", "y", "z", "w"}
_TIMES = ({"sec", "nanosec"}, {"seconds", "nanos"})
"""The fields of times and durations, which are not measured."""
_GEOGRAPHIC = frozenset({"position", "latitude", "longitude", "altitude"})
"""The names of fields that depend on where a recording is made, so that their range is never stable."""
_STABLE_SHARE = 0.25
"""Maximum distance between the limits of both halves of a recording, as a share of the range of all values."""
_MAX_TEXT = 64
"""Maximum length of a text that can be expected."""


class FieldKind(Enum):
    """The kind of a measured expression."""

    FIELD = "field"
    VECTOR = "vector"
    """The norm of a vector."""
    QUATERNION = "quaternion"
    """The norm of a quaternion."""


class MeasuredField(Struct, frozen=True):
    """The values of an expression in one recording."""

    kind: FieldKind = FieldKind.FIELD
    limits: tuple[float, float] | None = None
    """The smallest and the largest floating-point number; None for other values, and if a number is not finite."""
    is_stable: bool = False
    """Whether both halves of the recording have about the same limits, and other recordings may have them, too."""
    constant: str | int | None = None
    """The only text or whole number of all messages; None if there are several, and for zero and empty texts."""
    nulls: int | None = None
    """Number of messages without a value; None if the type of the message requires a value."""


class FieldMeter:
    """Measures expressions over the messages of one topic."""

    def __init__(self, topic: str, definition: Definition, middle_ns: int) -> None:
        """Create the meter; `middle_ns` is the log time that divides the recording into halves."""
        self._topic = topic
        self._msgtype = definition.root
        self._middle_ns = middle_ns
        self._is_nullable = definition.language is not Language.ROS
        rows = message_rows(definition)
        meters: list[_Meter] = []
        for text, kind in _expressions(rows.struct, ""):
            expression, _ = bind_expression(text, rows, None, lambda _start, _end: None)
            if expression is not None and len(meters) < MAX_FIELDS:
                name = text.rstrip(")").rpartition(".")[2].removeprefix("norm(")
                meters.append(_Meter(expression, kind, is_geographic=name in _GEOGRAPHIC))
        self._meters = tuple(meters)

    def __bool__(self) -> bool:
        return bool(self._meters)

    def add(self, rows: pa.StructArray, log_times: NDArray[np.int64]) -> None:
        """Add decoded messages in the ROS shape."""
        evaluator = Evaluator(rows, Envelope(self._topic, self._msgtype, log_times))
        is_second = log_times >= self._middle_ns
        for meter in self._meters:
            meter.add(evaluator.values(meter.expression), is_second)

    def finish(self) -> dict[str, MeasuredField]:
        """Return the measured values by expression, without expressions that have no value."""
        return {
            meter.expression.text: meter.result(is_nullable=self._is_nullable)
            for meter in self._meters
            if meter.count
        }


@dataclass(slots=True)
class _Meter:
    """Measures one expression."""

    expression: FieldExpression
    kind: FieldKind
    is_geographic: bool
    count: int = 0
    nulls: int = 0
    is_finite: bool = True
    halves: list[tuple[float, float] | None] = field(default_factory=lambda: [None, None])
    """The smallest and the largest number of each half of the recording."""
    constants: set[str | int] = field(default_factory=set[str | int])
    """The different texts or whole numbers, no more after the second one."""

    def add(self, values: Values, is_second: NDArray[np.bool_]) -> None:
        """Add the values of a batch, one per row."""
        data = values.data
        if values.null is not None:
            self.nulls += int(values.null.sum())
            data, is_second = data[~values.null], is_second[~values.null]
        if not len(data):
            return
        self.count += len(data)
        if not np.issubdtype(data.dtype, np.floating):
            if len(self.constants) <= 1:
                self.constants |= {data[0], *data[data != data[0]][:1]}
        elif not np.isfinite(data).all():
            self.is_finite = False
        else:
            for half, of_half in enumerate((data[~is_second], data[is_second])):
                if len(of_half):
                    low, high = self.halves[half] or (np.inf, -np.inf)
                    self.halves[half] = (min(low, float(of_half.min())), max(high, float(of_half.max())))

    def result(self, *, is_nullable: bool) -> MeasuredField:
        """Return the measured values."""
        halves = [half for half in self.halves if half is not None] if self.is_finite else []
        limits = (min(low for low, _ in halves), max(high for _, high in halves)) if halves else None
        distance = 0.0 if limits is None else _STABLE_SHARE * (limits[1] - limits[0])
        (constant,) = self.constants if len(self.constants) == 1 else (None,)
        return MeasuredField(
            kind=self.kind,
            limits=limits,
            is_stable=len(halves) == len(self.halves)
            and not self.is_geographic
            and all(abs(first - second) <= distance for first, second in zip(*halves, strict=True)),
            constant=_plain(constant) if constant else None,
            nulls=self.nulls if is_nullable else None,
        )


def _expressions(struct: pa.StructType, prefix: str) -> Iterator[tuple[str, FieldKind]]:
    """Yield the norms of the vectors and quaternions of a message, and its other numbers and texts outside of lists."""
    for member in struct:
        path, kind = f"{prefix}{member.name}", member.type
        if pt.is_struct(kind):
            names = {child.name for child in kind}
            is_floating = all(pt.is_floating(child.type) for child in kind)
            if is_floating and names == _QUATERNION:
                yield f"norm({path})", FieldKind.QUATERNION
            elif is_floating and names in _VECTORS:
                yield f"norm({path})", FieldKind.VECTOR
            elif names not in _TIMES and member.name != "header":
                yield from _expressions(kind, f"{path}.")
        elif is_number(kind) or pt.is_string(kind):
            yield path, FieldKind.FIELD


def _plain(constant: str | int) -> str | int | None:
    """Return a constant as a Python value; None for a text that is too long."""
    if isinstance(constant, str):
        return constant if len(constant) <= _MAX_TEXT else None
    return int(constant)
