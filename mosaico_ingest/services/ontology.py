"""Ontology types for people: their names, and their fields with types, units and nullability."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.adapters.mapping.types import format_type, is_list
from mosaico_ingest.ontology.registry import model, ontology_type, tags
from mosaico_ingest.ontology.units import column_unit


class OntologySummary(Struct, frozen=True):
    """An ontology type in a list."""

    tag: str
    fields: int
    """Number of top-level fields."""
    summary: str
    adapters: tuple[str, ...]
    """The built-in adapters that produce the type."""


class OntologyField(Struct, frozen=True):
    """A field of an ontology type, or a field inside it."""

    name: str
    """The path, such as `acceleration.x`; `transforms[].header` is a field of the elements of a list."""
    type: str
    nullable: bool
    unit: str
    """Empty if the field has no unit."""


class OntologyDescription(Struct, frozen=True):
    """An ontology type with its fields."""

    tag: str
    summary: str
    format: str
    """The serialization format on the platform."""
    fingerprint: str
    """Identifies the columns."""
    adapters: tuple[str, ...]
    """The built-in adapters that produce the type."""
    fields: tuple[OntologyField, ...]
    """All fields, each followed by the fields inside it."""


def known_ontologies(glob: str | None = None) -> tuple[OntologySummary, ...]:
    """Return the ontology types whose tag matches a glob, in alphabetical order."""
    return tuple(
        OntologySummary(tag, ontology_type(tag).struct.num_fields, _summary(tag), _adapters(tag))
        for tag in tags()
        if glob is None or fnmatchcase(tag.lower(), glob.lower())
    )


def describe_ontology(tag: str) -> OntologyDescription:
    """Return an ontology type with all of its fields.

    Raises:
        UnknownTag: No type has the tag; the hint names the nearest tag.
    """
    ontology = ontology_type(tag)
    return OntologyDescription(
        tag,
        _summary(tag),
        ontology.serialization_format.value,
        ontology.fingerprint,
        _adapters(tag),
        tuple(_fields(tag, ontology.struct, "")),
    )


def _summary(tag: str) -> str:
    return (model(tag).__doc__ or "").strip().partition("\n")[0]


def _adapters(tag: str) -> tuple[str, ...]:
    return tuple(builtin.name for builtin in BUILTIN if builtin.tag == tag)


def _fields(tag: str, struct: pa.StructType, prefix: str) -> Iterator[OntologyField]:
    for field in struct:
        path = f"{prefix}{field.name}"
        unit = column_unit(tag, path.replace("[]", ""))
        yield OntologyField(path, format_type(field.type), field.nullable, unit)
        element: Any = field.type  # the stubs of nested types are incomplete
        while is_list(element):
            element, path = element.value_type, f"{path}[]"
        if pt.is_struct(element):
            yield from _fields(tag, element, f"{path}.")
