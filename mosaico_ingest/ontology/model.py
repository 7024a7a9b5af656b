"""The base of ontology models, and the models of time stamps and headers.

```
class Sonar(Serializable):
    beams: list[Float32]                            # list<item: float> not null
    gain: Float32 | None = None                     # float
    rotation: Annotated[list[Float64], FixedSize(9)]  # fixed_size_list<item: double>[9] not null
    payload: Annotated[bytes, pa.large_binary()]    # any Arrow type, used unchanged
```
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta, timezone
from enum import Enum
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, cast, get_args, get_origin

import pyarrow as pa
from msgspec import Struct
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    SerializeAsAny,
    ValidationError,
)
from pydantic_core import CoreSchema, core_schema
from typing_extensions import Self

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.registry import DEFINED, MODULES, OntologyType, SerializationFormat

Int8 = Annotated[int, Field(ge=-(2**7), lt=2**7), pa.int8()]
Int16 = Annotated[int, Field(ge=-(2**15), lt=2**15), pa.int16()]
Int32 = Annotated[int, Field(ge=-(2**31), lt=2**31), pa.int32()]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63), pa.int64()]
UInt8 = Annotated[int, Field(ge=0, lt=2**8), pa.uint8()]
UInt16 = Annotated[int, Field(ge=0, lt=2**16), pa.uint16()]
UInt32 = Annotated[int, Field(ge=0, lt=2**32), pa.uint32()]
UInt64 = Annotated[int, Field(ge=0, lt=2**64), pa.uint64()]
Float16 = Annotated[float, pa.float16()]
Float32 = Annotated[float, pa.float32()]
Float64 = Annotated[float, pa.float64()]


class Nullable(Struct, frozen=True):
    """Marks a column that may contain nulls, although the model requires a value."""


class FixedSize(Struct, frozen=True):
    """Marks a list of exactly `length` values."""

    length: int

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401 - pydantic's signature
        """Validate the items, then their number."""
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def check(self, values: list[Any]) -> list[Any]:
        """Return the list if it has the right length; raises ValueError otherwise."""
        if len(values) != self.length:
            raise ValueError(f"expected {self.length} values, found {len(values)}")
        return values


_PLAIN: dict[type, pa.DataType] = {
    bool: pa.bool_(),  # precedes int, because bool is a subclass of int
    int: pa.int64(),
    float: pa.float64(),
    str: pa.string(),
    bytes: pa.binary(),
}


@cache
def struct_of(model: type[BaseModel]) -> pa.StructType:
    """Return the columns of `model`, in the order of its fields.

    Raises:
        AdapterError: A field's annotation has no Arrow type.
    """
    return _struct(model, ())


class _Column(Struct, frozen=True):
    """An analyzed annotation: the bare type and its marks."""

    bare: Any
    nullable: bool
    exact: pa.DataType | None
    size: int


def _struct(model: type[BaseModel], outer: tuple[type[BaseModel], ...]) -> pa.StructType:
    if model in outer:
        raise AdapterError(
            "a model that contains itself has no columns",
            where=model.__name__,
            hint="refer to the inner model by a key",
        )
    inside = (*outer, model)
    fields: list[pa.Field[Any]] = []
    for name, field in model.model_fields.items():
        column = _analyze(field.annotation, field.metadata)
        data_type = _arrow(column, f"{model.__name__}.{name}", inside)
        fields.append(pa.field(name, data_type, nullable=column.nullable))
    return pa.struct(fields)


def _analyze(annotation: Any, metadata: Iterable[object] = ()) -> _Column:  # noqa: ANN401 - any annotation
    marks = list(metadata)
    nullable = False
    while True:
        origin = get_origin(annotation)
        if origin is Annotated:
            annotation, *more = get_args(annotation)
            marks += more
        elif origin in (Union, types.UnionType) and type(None) in get_args(annotation):
            rest = tuple(arg for arg in get_args(annotation) if arg is not type(None))
            annotation, nullable = Union[rest], True  # noqa: UP007 - a tuple has no spelling with |
        else:
            break
    exact = next((mark for mark in marks if isinstance(mark, pa.DataType)), None)
    size = next((mark.length for mark in marks if isinstance(mark, FixedSize)), -1)
    nullable = nullable or any(mark is Nullable or isinstance(mark, Nullable) for mark in marks)
    return _Column(annotation, nullable, exact, size)


def _arrow(column: _Column, where: str, outer: tuple[type[BaseModel], ...]) -> pa.DataType:
    if column.exact is not None:
        return column.exact
    bare = column.bare
    if get_origin(bare) in (list, tuple, Sequence):
        return _list(column, where, outer)
    if get_origin(bare) is Literal:
        kinds = {type(value) for value in get_args(bare)}
        bare = kinds.pop() if len(kinds) == 1 else bare
    if isinstance(bare, type):
        if issubclass(bare, BaseModel):
            return _struct(bare, outer)
        plain = next((arrow for kind, arrow in _PLAIN.items() if issubclass(bare, kind)), None)
        if plain is not None and (bare in _PLAIN or issubclass(bare, Enum)):
            return plain
    raise AdapterError(
        f"the annotation {_spell(bare)} has no column type",
        where=where,
        hint="use bool, int, float, str, bytes, a list, a nested model, or Annotated[…, <an Arrow type>]",
    )


def _list(column: _Column, where: str, outer: tuple[type[BaseModel], ...]) -> pa.DataType:
    items = [arg for arg in get_args(column.bare) if arg is not ...]
    if len(items) != 1:
        raise AdapterError(
            f"the annotation {_spell(column.bare)} mixes item types", where=where, hint="use a nested model"
        )
    item = pa.field("item", _arrow(_analyze(items[0]), f"{where}[]", outer))
    return pa.list_(item, column.size)


def _spell(annotation: object) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


_MISFITS = (pa.ArrowException, OverflowError, TypeError, ValueError)


class Serializable(BaseModel):
    """A row of one topic. Subclass it with annotated fields; its columns are derived from them.

    `int` becomes int64, `float` double, `bytes` binary, `list[X]` a list, `X | None` a nullable column, a nested
    model a struct; `ontology.fields` names the exact types.
    """

    model_config = ConfigDict(extra="forbid", validate_assignment=True, defer_build=True)

    __ontology_tag__: ClassVar[str]
    """The tag that the platform stores; by default the name of the class."""
    __serialization_format__: ClassVar[SerializationFormat] = SerializationFormat.DEFAULT

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:  # noqa: ANN401 - pydantic's signature
        """Register the class by its tag.

        Raises:
            AdapterError: The tag belongs to a built-in model with other columns.
        """
        super().__pydantic_init_subclass__(**kwargs)
        tag = cls.__dict__.get("__ontology_tag__", cls.__name__)
        if tag in MODULES and cls.__module__ != f"{__package__}.{MODULES[tag]}":
            raise AdapterError(
                f"the tag {tag!r} belongs to a built-in model",
                where=f"{cls.__module__}.{cls.__qualname__}",
                hint="rename the class or set __ontology_tag__",
            )
        cls.__ontology_tag__ = tag
        DEFINED[tag] = cls

    @classmethod
    def ontology_tag(cls) -> str:
        """Return the tag, such as `IMU`."""
        return cls.__ontology_tag__

    @classmethod
    def ontology_type(cls) -> OntologyType:
        """Return tag, columns and serialization format.

        Raises:
            AdapterError: A field's annotation has no Arrow type.
        """
        return OntologyType(cls.__ontology_tag__, cls._columns(), cls.__serialization_format__)

    @classmethod
    def to_batch(cls, models: Iterable[Self]) -> pa.StructArray:
        """Return a struct array with one row per model.

        Raises:
            AdapterError: A value does not fit its column; the error names the row.
        """
        rows, columns = [model.to_row() for model in models], cls._columns()
        try:
            return _array(rows, columns)
        except _MISFITS as error:
            reasons = ((at, _misfit(row, columns)) for at, row in enumerate(rows))
            at, reason = next(((at, reason) for at, reason in reasons if reason), (0, str(error)))
            raise AdapterError(f"row {at}: {reason}", where=cls.__ontology_tag__) from error

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> Self:
        """Return the model of a row of Arrow values; a struct that contains only nulls counts as null.

        Raises:
            AdapterError: A value violates the model; the error names the field and the value.
        """
        try:
            return cls.model_validate({name: _without_empty(value) for name, value in row.items()})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            location = ".".join((cls.__ontology_tag__, *map(str, first["loc"])))
            raise AdapterError(f"{first['msg']}, found {first['input']!r:.80}", where=location) from error

    def to_row(self) -> dict[str, Any]:
        """Return the values of the columns."""
        return self.model_dump()

    @classmethod
    def _columns(cls) -> pa.StructType:
        return struct_of(cls)


def _array(rows: list[dict[str, Any]], columns: pa.StructType) -> pa.StructArray:
    return cast("pa.StructArray", pa.array(rows, type=columns))  # the class follows from the type


def _misfit(row: dict[str, Any], columns: pa.StructType) -> str | None:
    """Return the reason why a row does not fit its columns, or None if it fits."""
    try:
        _array([row], columns)
    except _MISFITS as reason:
        return str(reason)
    return None


def _without_empty(value: Any) -> Any:  # noqa: ANN401 - any cell
    """Replace every struct that contains only nulls with None."""
    if not isinstance(value, dict):
        return value
    cells = {name: _without_empty(cell) for name, cell in value.items()}
    return cells if any(cell is not None for cell in cells.values()) else None


_SECOND = 1_000_000_000
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class _SecondsAndNanoseconds(BaseModel):
    """A signed time span in two parts; `nanoseconds` is never negative."""

    seconds: Int32
    """Seconds, rounded down."""
    nanoseconds: Annotated[UInt32, Field(lt=_SECOND)]
    """Remaining nanoseconds, in [0, 1e9)."""

    @classmethod
    def from_nanoseconds(cls, nanoseconds: int) -> Self:
        """Return the span for a number of ns."""
        seconds, rest = divmod(nanoseconds, _SECOND)
        return cls(seconds=seconds, nanoseconds=rest)

    def to_nanoseconds(self) -> int:
        """Return the span in ns, exactly."""
        return self.seconds * _SECOND + self.nanoseconds

    @classmethod
    def from_milliseconds(cls, milliseconds: int) -> Self:
        """Return the span for a number of ms."""
        return cls.from_nanoseconds(milliseconds * 1_000_000)

    def to_milliseconds(self) -> int:
        """Return the span in ms, rounded down."""
        return self.to_nanoseconds() // 1_000_000

    @classmethod
    def from_float(cls, seconds: float) -> Self:
        """Return the span nearest to a number of seconds."""
        return cls.from_nanoseconds(round(seconds * _SECOND))

    def to_float(self) -> float:
        """Return the span in s; a double resolves about 0.2 µs of a present-day time."""
        return self.to_nanoseconds() / _SECOND


class Time(_SecondsAndNanoseconds, Serializable):
    """A point in time, since the epoch or since the start of a simulation."""

    @classmethod
    def from_datetime(cls, moment: datetime) -> Self:
        """Return the time of a `datetime`; one without a time zone counts as UTC."""
        aware = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        return cls.from_nanoseconds((aware - _EPOCH) // timedelta(microseconds=1) * 1000)

    def to_datetime(self) -> datetime:
        """Return the time in UTC, rounded down to microseconds."""
        return _EPOCH + timedelta(microseconds=self.to_nanoseconds() // 1000)

    @classmethod
    def now(cls) -> Self:
        """Return the current time."""
        return cls.from_datetime(datetime.now(timezone.utc))


class Duration(_SecondsAndNanoseconds, Serializable):
    """A span of time; a negative one has negative `seconds`."""


class Header(Serializable):
    """The sender's time stamp and the coordinate frame of the values."""

    timestamp: Time | None = None
    """The time stamp on the sender's clock."""
    frame_id: str | None = None
    """The coordinate frame."""
    sample_counter: UInt64 | None = None
    """A counter of the sender, such as `seq` in ROS 1."""


class Stamped(BaseModel):
    """The base of all models with a header, which is their first column."""

    header: Header | None = None
    """Time stamp and frame of the values; null if the sender set neither."""


_Model = TypeVar("_Model", bound=Serializable)


def _ontology_object(value: object) -> object:
    """Return an ontology object of this package or of the official SDK."""
    if not isinstance(value, BaseModel) or not hasattr(value, "ontology_tag"):
        raise ValueError(f"{type(value).__name__} is no ontology object")
    return value


class Message(BaseModel):
    """A row with its log time."""

    model_config = ConfigDict(extra="forbid", defer_build=True)

    timestamp_ns: int
    """Log time, ns since the epoch."""
    data: Annotated[SerializeAsAny[Serializable], PlainValidator(_ontology_object)]
    """The row."""

    def get_data(self, model: type[_Model]) -> _Model | None:
        """Return the row if it is an instance of `model`, else None."""
        return self.data if isinstance(self.data, model) else None

    def ontology_tag(self) -> str:
        """Return the tag of the row."""
        return self.data.ontology_tag()
