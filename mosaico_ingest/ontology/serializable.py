"""This file is the base of every ontology model: annotated fields in, Arrow columns and batches out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, cast

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, ValidationError
from typing_extensions import Self

from mosaico_ingest.errors import AdapterError
from mosaico_ingest.ontology.schema import struct_of
from mosaico_ingest.ontology.tags import DEFINED, MODULES
from mosaico_ingest.ontology.types import OntologyType, SerializationFormat

__all__ = ["Serializable"]

_MISFITS = (pa.ArrowException, OverflowError, TypeError, ValueError)


class Serializable(BaseModel):
    """A row of one topic. Subclass it with annotated fields; its columns are derived from them.

    `int` becomes int64, `float` double, `bytes` binary, `list[X]` a list, `X | None` a nullable column, a nested
    model a struct; `ontology.fields` names the exact types.
    """

    model_config = ConfigDict(extra="forbid", validate_assignment=True, defer_build=True)

    __ontology_tag__: ClassVar[str]
    """The name the platform stores; the class's own name where nothing is said."""
    __serialization_format__: ClassVar[SerializationFormat] = SerializationFormat.DEFAULT

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:  # noqa: ANN401 - pydantic's signature
        """Make the class known by its tag.

        Raises:
            AdapterError: The tag is a built-in's, whose readers expect the built-in's columns.
        """
        super().__pydantic_init_subclass__(**kwargs)
        tag = cls.__dict__.get("__ontology_tag__", cls.__name__)
        if tag in MODULES and cls.__module__ != f"{__package__}.{MODULES[tag]}":
            raise AdapterError(
                f"the tag {tag!r} is a built-in's",
                where=f"{cls.__module__}.{cls.__qualname__}",
                hint="rename the class or set __ontology_tag__",
            )
        cls.__ontology_tag__ = tag
        DEFINED[tag] = cls

    @classmethod
    def ontology_tag(cls) -> str:
        """Return the tag, as `IMU`."""
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
        """Return one row a model.

        Raises:
            AdapterError: A value does not fit its column; names the row.
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
        """Return the model of one row as Arrow gives it; a struct of nulls alone counts as null.

        Raises:
            AdapterError: The values break the model's rules; names the field and the value.
        """
        try:
            return cls.model_validate({name: _without_empty(value) for name, value in row.items()})
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = ".".join((cls.__ontology_tag__, *map(str, first["loc"])))
            raise AdapterError(f"{first['msg']}, found {first['input']!r:.80}", where=place) from error

    def to_row(self) -> dict[str, Any]:
        """Return the values of the columns."""
        return self.model_dump()

    @classmethod
    def _columns(cls) -> pa.StructType:
        return struct_of(cls)


def _array(rows: list[dict[str, Any]], columns: pa.StructType) -> pa.StructArray:
    return cast("pa.StructArray", pa.array(rows, type=columns))  # the class follows from the type


def _misfit(row: dict[str, Any], columns: pa.StructType) -> str | None:
    """Return why `row` does not fit, None where it does."""
    try:
        _array([row], columns)
    except _MISFITS as reason:
        return str(reason)
    return None


def _without_empty(value: Any) -> Any:  # noqa: ANN401 - any cell
    """Return `value` with every struct of nothing but nulls replaced by None."""
    if not isinstance(value, dict):
        return value
    cells = {name: _without_empty(cell) for name, cell in value.items()}
    return cells if any(cell is not None for cell in cells.values()) else None
