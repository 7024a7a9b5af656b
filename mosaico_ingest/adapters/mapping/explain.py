"""This file says of every column of an adapter where it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from mosaico_ingest.adapters.mapping.build import (
    Absent,
    ByAdapter,
    ByFields,
    Computed,
    Filled,
    Looked,
    Source,
)
from mosaico_ingest.adapters.mapping.kinds import spell
from mosaico_ingest.adapters.mapping.load import MappingAdapter

__all__ = ["Origin", "explain"]


@dataclass(frozen=True, slots=True)
class Origin:
    """A column and what fills it."""

    column: str
    """With those around it, as `pose.position`."""
    type: str
    required: bool
    source: str
    """An expression, as written, and what is done with it."""


def explain(adapter: MappingAdapter) -> tuple[Origin, ...]:
    """Return the columns of a bound adapter in order, structs that are filled field by field as their fields."""
    return tuple(_origins(adapter.record))


def _origins(filled: Filled) -> Iterator[Origin]:
    source = filled.source
    split = isinstance(source, ByFields) and source.of is None and filled.when is None
    if filled.name and not split:
        condition = f" when {filled.when.text}" if filled.when is not None else ""
        yield Origin(filled.path, spell(filled.type), not filled.nullable, _words(source) + condition)
    if isinstance(source, ByFields):
        replaced = {field.name for field in filled.replaced}
        yield from (o for field in source.fields if field.name not in replaced for o in _origins(field))
    yield from (origin for field in filled.replaced for origin in _origins(field))


def _words(source: Source) -> str:
    match source:
        case Absent():
            return "null"
        case Computed():
            return source.typed.text
        case Looked():
            rest = "rejected" if source.otherwise is None else source.otherwise.text
            return f"{source.typed.text}: {_table(source)}, else {rest}"
        case ByAdapter():
            return f"{source.name} of {source.of.text}"
        case ByFields():
            return "its fields" if source.of is None else f"fields of {source.of.text}"


def _table(source: Looked) -> str:
    pairs = zip(source.keys.to_pylist(), source.values.to_pylist(), strict=True)
    return ", ".join(f"{key} → {'null' if value is None else value}" for key, value in pairs)
