"""Ontology types that an adapter file declares itself, under `ontology: {tag, fields}`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

import pyarrow as pa

from mosaico_ingest.adapters.mapping.analyzer import Analyzer
from mosaico_ingest.adapters.mapping.checker import CAST_TYPES
from mosaico_ingest.adapters.mapping.columns import DataType, arrays
from mosaico_ingest.adapters.mapping.functions.registry import suggest
from mosaico_ingest.adapters.mapping.model import FieldDeclaration, FieldType, InlineType
from mosaico_ingest.ontology.registry import MODULES, UnknownTag, ontology_type
from mosaico_ingest.ontology.types import OntologyType

if TYPE_CHECKING:
    from mosaico_ingest.job.yaml_source import KeyPath

PLAIN_TYPES: dict[str, DataType] = {**CAST_TYPES, "string": arrays.string(), "binary": arrays.binary()}
_LIST = re.compile(r"list\[\s*(?P<element>.+?)\s*(,\s*(?P<size>\d+)\s*)?\]")
_ENVELOPE_COLUMN = "timestamp_ns"
_LIST_OF_STRUCTS = "list"


def inline_ontology_type(inline: InlineType, analyzer: Analyzer, base: KeyPath = ()) -> OntologyType:
    """Return the ontology type declared below the key path `base`; fields with a finding are omitted."""
    path: KeyPath = (*base, "ontology", "fields")
    if _ENVELOPE_COLUMN in inline.fields:
        message = f"{_ENVELOPE_COLUMN} is the column of the log time"
        analyzer.report((*path, _ENVELOPE_COLUMN), message, "rename the field")
    if inline.tag in MODULES:
        message = f"{inline.tag!r} is a built-in tag with its own columns"
        hint = f"write ontology: {inline.tag}, or choose another tag"
        analyzer.report_value((*base, "ontology", "tag"), message, hint)
    return OntologyType(inline.tag, pa.struct(_fields(inline.fields, path, analyzer)), inline.format)


def _fields(fields: Mapping[str, FieldType], path: KeyPath, analyzer: Analyzer) -> list[DataType]:
    columns = (_field(name, field, (*path, name), analyzer) for name, field in fields.items())
    return [column for column in columns if column is not None]


def _field(name: str, field: FieldType, path: KeyPath, analyzer: Analyzer) -> DataType | None:
    if not name.isidentifier():  # Queries and SQL separate nested fields with dots.
        analyzer.report(path, f"{name!r} is not a valid field name", "use letters, digits and _")
        return None
    declaration = FieldDeclaration(type=field) if isinstance(field, str) else field
    type_: DataType | None
    if declaration.fields is not None and declaration.type in {None, _LIST_OF_STRUCTS}:
        struct = pa.struct(_fields(declaration.fields, (*path, "fields"), analyzer))
        type_ = struct if declaration.type is None else arrays.list_(struct)
    elif declaration.type is None or declaration.fields is not None:
        hint = "write {type: float64}, {fields: {…}}, or {type: list, fields: {…}}"
        analyzer.report(path, f"the field {name!r} needs either type or fields", hint)
        return None
    else:
        type_path = path if isinstance(field, str) else (*path, "type")
        type_ = _type(declaration.type, type_path, analyzer)
    return None if type_ is None else pa.field(name, type_, nullable=declaration.nullable)


def _type(text: str, path: KeyPath, analyzer: Analyzer) -> DataType | None:
    text = text.strip()
    if text in PLAIN_TYPES:
        return PLAIN_TYPES[text]
    match = _LIST.fullmatch(text)
    if match is not None:
        element = _type(match["element"], path, analyzer)
        if element is None:
            return None
        return arrays.list_(element, int(match["size"])) if match["size"] else arrays.list_(element)
    try:
        return ontology_type(text).struct
    except UnknownTag as error:
        nearest = suggest(text, PLAIN_TYPES) or error.hint
        types = f"use {', '.join(PLAIN_TYPES)}, list[T], list[T, N] or an ontology tag"
        hint = f"{nearest} {types}" if nearest and nearest.startswith("did you mean") else types
        analyzer.report_value(path, f"{text!r} is neither a type nor an ontology tag", hint)
        return None
