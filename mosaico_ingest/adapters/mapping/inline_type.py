"""This file makes the Arrow columns of an ontology type that an adapter file defines itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

import pyarrow as pa

from mosaico_ingest.adapters.mapping.arrow import DataType, arrays
from mosaico_ingest.adapters.mapping.model import FieldType, InlineType, TypedField
from mosaico_ingest.ontology.registry import UnknownTag, ontology_type
from mosaico_ingest.ontology.tags import MODULES
from mosaico_ingest.ontology.types import OntologyType

if TYPE_CHECKING:
    from mosaico_ingest.manifest.source import Path

__all__ = ["make_type"]

_PLAIN: dict[str, DataType] = {
    "bool": arrays.bool_(),
    "string": arrays.string(),
    "binary": arrays.binary(),
    **{
        f"{sign}int{bits}": getattr(arrays, f"{sign}int{bits}")()
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
    **{f"float{bits}": getattr(arrays, f"float{bits}")() for bits in (16, 32, 64)},
}
_LIST = re.compile(r"list\[\s*(?P<element>.+?)\s*(,\s*(?P<size>\d+)\s*)?\]")
_ENVELOPE = "timestamp_ns"
_LIST_OF_STRUCTS = "list"

Report: TypeAlias = "Callable[[Path, str, str | None], None]"
"""Takes a mistake: the path of the value, what, what to do."""


def make_type(inline: InlineType, report: Report) -> OntologyType:
    """Return the ontology type; a field with a mistake is reported and left out."""
    path: Path = ("ontology", "fields")
    if _ENVELOPE in inline.fields:
        report((*path, _ENVELOPE), f"{_ENVELOPE} is the envelope's column", "give the field another name")
    if inline.tag in MODULES:
        hint = f"write ontology: {inline.tag}, or give yours another tag"
        report(
            ("ontology", "tag"), f"the tag {inline.tag!r} is a built-in's, which has its own columns", hint
        )
    return OntologyType(inline.tag, pa.struct(_fields(inline.fields, path, report)), inline.format)


def _fields(fields: Mapping[str, FieldType], path: Path, report: Report) -> list[DataType]:
    made = (_field(name, field, (*path, name), report) for name, field in fields.items())
    return [field for field in made if field is not None]


def _field(name: str, field: FieldType, path: Path, report: Report) -> DataType | None:
    if not name.isidentifier():  # queries and SQL spell a path with dots
        report(path, f"a field cannot be called {name!r}", "use letters, digits and _")
        return None
    typed = TypedField(type=field) if isinstance(field, str) else field
    if typed.fields is not None and typed.type in {None, _LIST_OF_STRUCTS}:
        struct = pa.struct(_fields(typed.fields, (*path, "fields"), report))
        type_: DataType = struct if typed.type is None else arrays.list_(struct)
    elif typed.type is None or typed.fields is not None:
        hint = "as {type: float64}, {fields: {…}}, or {type: list, fields: {…}}"
        report(path, f"the field {name!r} needs either type or fields", hint)
        return None
    else:
        type_ = _type(typed.type, path if isinstance(field, str) else (*path, "type"), report)
    return None if type_ is None else pa.field(name, type_, nullable=typed.nullable)


def _type(text: str, path: Path, report: Report) -> DataType | None:
    text = text.strip()
    if text in _PLAIN:
        return _PLAIN[text]
    match = _LIST.fullmatch(text)
    if match is not None:
        element = _type(match["element"], path, report)
        if element is None:
            return None
        return arrays.list_(element, int(match["size"])) if match["size"] else arrays.list_(element)
    try:
        return ontology_type(text).struct
    except UnknownTag as unknown:
        hint = f"{unknown.hint or ''}; plain types are {', '.join(_PLAIN)}, list[T] and list[T, N]".lstrip(
            "; "
        )
        report(path, f"{text!r} is neither a type nor an ontology tag", hint)
        return None
