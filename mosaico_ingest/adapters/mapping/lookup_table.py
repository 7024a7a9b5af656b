"""This file compiles `{value, map, else}`: a table from what a field holds to what the ontology calls it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from mosaico_ingest.adapters.mapping.arrow import DataType, arrays, pt
from mosaico_ingest.adapters.mapping.build import Looked
from mosaico_ingest.adapters.mapping.check import Scope, constant
from mosaico_ingest.adapters.mapping.fit import demand, peel
from mosaico_ingest.adapters.mapping.kinds import Kind, Unfit, join, spell, within
from mosaico_ingest.adapters.mapping.model import Form, Scalar
from mosaico_ingest.adapters.mapping.typed import Const, FieldOf, Typed, Written
from mosaico_ingest.manifest.source import Path

__all__ = ["Desk", "compile_lookup"]


class Desk(Protocol):
    """What the compiler lends: reading expressions, noting mistakes."""

    def scalar(self, path: Path, value: Scalar, scope: Scope | None) -> Written | Const | None:
        """Compile a plain value or an expression."""
        ...

    def demand(self, at: Written | Path, kind: Kind, target: DataType) -> bool:
        """Check that values fit a column."""
        ...

    def report(self, path: Path, message: str, help_: str | None = None, *, rule: str = "mapping") -> None:
        """Note a mistake."""
        ...


def compile_lookup(
    desk: Desk, form: Form, path: Path, target: DataType, scope: Scope | None
) -> Looked | None:
    """Return the compiled table, or None after a finding or where there is no message."""
    value = desk.scalar((*path, "value"), form.value, scope)
    typed = value.typed if isinstance(value, Written) else value
    default = None
    if form.otherwise not in ("error", "keep"):
        default = desk.scalar((*path, "else"), form.otherwise, scope)
        if default is None:
            return None
    if typed is None or scope is None:
        return None
    try:
        element = peel(target, typed.kind.axes)
    except Unfit as unfit:
        desk.report((*path, "value"), str(unfit), unfit.hint, rule="misfit")
        return None
    table = _table(desk, form.map or {}, (*path, "map"), typed, element, scope)
    rest = typed if form.otherwise == "keep" else default.typed if isinstance(default, Written) else default
    where = (*path, "value" if form.otherwise == "keep" else "else")
    if table is None or (rest is not None and not desk.demand(where, rest.kind.element, element)):
        return None
    keys, values = table
    return Looked(typed, arrays.array(keys, typed.kind.type), arrays.array(values, element), rest)


def _table(
    desk: Desk, entries: Mapping[Scalar, Scalar], path: Path, typed: Typed, target: DataType, scope: Scope
) -> tuple[list[Scalar], list[Scalar]] | None:
    """Return keys and values that have the right types; None after a finding."""
    if pt.is_nested(target) or pt.is_nested(typed.kind.type):
        desk.report(
            path, f"a map is between plain values, not {spell(typed.kind.element)} and {spell(target)}"
        )
        return None
    keys: list[Scalar] = []
    good = True
    for key, value in entries.items():
        found = _key(desk, key, (*path, key), typed, scope)
        good = found is not None and _value_fits(desk, value, (*path, key), target) and good
        keys.append(found)
    return (keys, list(entries.values())) if good else None


def _value_fits(desk: Desk, value: Scalar, path: Path, target: DataType) -> bool:
    try:
        demand(constant(value).kind, target)
    except Unfit as unfit:
        desk.report(path, f"{value!r} → {unfit}", "map values are plain: text is text here", rule="misfit")
        return False
    return True


def _key(desk: Desk, key: Scalar, path: Path, typed: Typed, scope: Scope) -> Scalar:
    """Return what a key stands for; None after a finding."""
    kind, owner = typed.kind.element, typed.of.kind if isinstance(typed, FieldOf) else scope.kind
    if isinstance(key, str) and not pt.is_string(kind.type):
        value = scope.constant(owner, key)
        if value is None:
            known = scope.types.get(owner.msgtype or "")
            names = ", ".join(c.name for c in known.constants) if known and known.constants else "none"
            desk.report(
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
        desk.report(path, f"`{typed.text}` is {spell(kind)}, it is never {key!r}", rule="misfit")
        return None
    return key
