"""This file compiles `{value, map, else}`: a table from what a field holds to what the ontology calls it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mosaico_ingest.adapters.mapping.analyzer import Analyzer, Slot
from mosaico_ingest.adapters.mapping.arrow import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.build import Looked
from mosaico_ingest.adapters.mapping.check import constant
from mosaico_ingest.adapters.mapping.fit import demand
from mosaico_ingest.adapters.mapping.kinds import Unfit, join, spell, within
from mosaico_ingest.adapters.mapping.model import Form, Scalar
from mosaico_ingest.adapters.mapping.typed import FieldOf, Typed, Written

if TYPE_CHECKING:
    from mosaico_ingest.manifest.source import Path

__all__ = ["compile_lookup"]


def compile_lookup(analyzer: Analyzer, form: Form, slot: Slot) -> Looked | None:
    """Return the compiled table, or None after a finding or where there is no message."""
    value = analyzer.scalar((*slot.path, "value"), form.value, slot.scope)
    typed = value.typed if isinstance(value, Written) else value
    default = None
    if form.otherwise not in {"error", "keep"}:
        default = analyzer.scalar((*slot.path, "else"), form.otherwise, slot.scope)
        if default is None:
            return None
    if typed is None or slot.scope is None:
        return None
    element = analyzer.peeled((*slot.path, "value"), typed.kind, slot.type)
    if element is None:
        return None
    table = _table(analyzer, form.map or {}, typed, replace(slot.at("map"), type=element))
    rest = typed if form.otherwise == "keep" else default.typed if isinstance(default, Written) else default
    where = (*slot.path, "value" if form.otherwise == "keep" else "else")
    if table is None or (rest is not None and not analyzer.demand(where, rest.kind.element, element)):
        return None
    return Looked(typed, arrays.array(table[0], typed.kind.type), arrays.array(table[1], element), rest)


def _table(
    analyzer: Analyzer, entries: Mapping[Scalar, Scalar], typed: Typed, slot: Slot
) -> tuple[list[Scalar], list[Scalar]] | None:
    """Return keys and values that have the right types; None after a finding."""
    if pt.is_nested(slot.type) or pt.is_nested(typed.kind.type):
        message = f"a map is between plain values, not {spell(typed.kind.element)} and {spell(slot.type)}"
        analyzer.report(slot.path, message, rule="misfit")
        return None
    keys = [_key(analyzer, key, typed, slot) for key in entries]
    fitting = [_value_fits(analyzer, value, (*slot.path, key), slot.type) for key, value in entries.items()]
    return (keys, list(entries.values())) if all(fitting) and None not in keys else None


def _value_fits(analyzer: Analyzer, value: Scalar, path: Path, target: DataType) -> bool:
    try:
        demand(constant(value).kind, target)
    except Unfit as unfit:
        analyzer.misfit(path, unfit)
        return False
    return True


def _key(analyzer: Analyzer, key: Scalar, typed: Typed, slot: Slot) -> Scalar:
    """Return what a key stands for; None after a finding."""
    path, scope = (*slot.path, key), slot.scope
    if scope is None:
        return None
    kind, owner = typed.kind.element, typed.of.kind if isinstance(typed, FieldOf) else scope.kind
    if isinstance(key, str) and not pt.is_string(kind.type):
        value = scope.constant(owner, key)
        if value is None:
            known = scope.types.get(owner.msgtype or "")
            names = ", ".join(c.name for c in known.constants) if known and known.constants else "none"
            analyzer.report(
                path,
                f"no constant {key!r} in {spell(owner.element)}",
                f"it has {names}",
                rule="unknown-field",
            )
        return value
    own = constant(key).kind
    try:
        join([own, kind])
        fits = own.bounds is None or kind.bounds is None or within(own.bounds, kind.bounds)
    except Unfit:
        fits = False
    if not fits or key is None:
        analyzer.report(path, f"`{typed.text}` is {spell(kind)}, it is never {key!r}", rule="misfit")
        return None
    return key
