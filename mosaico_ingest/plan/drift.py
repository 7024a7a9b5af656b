"""This file says how the decisions of two plans differ, in the words of the plan."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeAlias

from mosaico_ingest.frozen import frozen
from mosaico_ingest.plan.document import Decisions

__all__ = ["Difference", "differences"]

Json: TypeAlias = Any

_NAMES = {"topics": ("topic", "target"), "left_out": ("left out", "topic"), "files": ("file", "path")}
"""How an item of a list is called, and the key that tells it from the others."""


@frozen
class Difference:
    """One thing that is not the same; what is not there on one side is None."""

    sequence: str
    what: str
    before: str | None
    after: str | None

    def __str__(self) -> str:
        """Return the difference in one line."""
        if self.before is None:
            return f"{self.sequence}: + {self.what}: {self.after}"
        if self.after is None:
            return f"{self.sequence}: - {self.what}: {self.before}"
        return f"{self.sequence}: {self.what}: {self.before} → {self.after}"


def differences(before: Sequence[Decisions], after: Sequence[Decisions]) -> tuple[Difference, ...]:
    """Return what changes from one plan to the other; recordings are told by their sequence, else by their files."""
    return tuple(
        difference
        for old, new in _pairs(before, after)
        for difference in (_recording(old, new) if old and new else [_alone(old, new)])
    )


def _pairs(
    before: Sequence[Decisions], after: Sequence[Decisions]
) -> Iterator[tuple[Decisions | None, Decisions | None]]:
    rest = list(after)
    unpaired: list[Decisions] = []
    for old in before:
        new = next((one for one in rest if one.sequence == old.sequence), None)
        if new is None:
            unpaired.append(old)
            continue
        rest.remove(new)
        yield old, new
    for old in unpaired:
        same = [one for one in rest if one.files == old.files]
        new = same[0] if same else rest[0] if len(rest) == len(unpaired) == 1 else None
        if new is not None:
            rest.remove(new)
        yield old, new
    yield from ((None, new) for new in rest)


def _alone(old: Decisions | None, new: Decisions | None) -> Difference:
    def shown(one: Decisions | None) -> str | None:
        return one and f"{', '.join(part.path for part in one.files)}, {len(one.topics)} topics"

    some = old or new
    return Difference(some.sequence if some else "", "recording", shown(old), shown(new))


def _recording(old: Decisions, new: Decisions) -> Iterator[Difference]:
    found = _mapping("", old.model_dump(mode="json"), new.model_dump(mode="json"))
    yield from (Difference(old.sequence, what, before, after) for what, before, after in found)


_Found: TypeAlias = "tuple[str, str | None, str | None]"


def _mapping(name: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Found]:
    for key in dict.fromkeys((*old, *new)):
        inner = f"{name} {key}".strip()
        if key not in old or key not in new:
            yield inner, _shown(old.get(key)), _shown(new.get(key))
        else:
            yield from _value(inner, key, old[key], new[key])


def _value(name: str, key: str, old: Json, new: Json) -> Iterator[_Found]:
    if old == new:
        return
    if isinstance(old, dict) and isinstance(new, dict):
        yield from _mapping(name, old, new)
    elif key in _NAMES:
        kind, identity = _NAMES[key]
        yield from _items(
            kind, {item[identity]: item for item in old}, {item[identity]: item for item in new}
        )
    else:
        yield name, _shown(old) or "none", _shown(new) or "none"


def _items(kind: str, old: Mapping[str, Json], new: Mapping[str, Json]) -> Iterator[_Found]:
    for identity in dict.fromkeys((*old, *new)):
        name = f"{kind} {identity}"
        if identity in old and identity in new:
            yield from _mapping(name, old[identity], new[identity])
        else:
            yield name, _summary(old.get(identity)), _summary(new.get(identity))


def _summary(item: Mapping[str, Json] | None) -> str | None:
    """Return what matters of an item that is on one side only."""
    if item is None:
        return None
    if "adapter" in item:
        return f"{item['msgtype']} by {item['adapter']} to {item['ontology']}"
    return item["why"] if "why" in item else f"{item['size_bytes']} bytes"


def _shown(value: Json) -> str | None:
    if value is None or isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False)
