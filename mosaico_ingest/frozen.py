"""This file makes small immutable classes cheaply: `dataclass(frozen=True)` writes and compiles six methods for each.

For the two hundred classes of a run that was an eighth of its start-up. Here only `__init__` is made; comparing, hashing
and showing are written once. That nothing is assigned to is the type checker's to see, so objects are made faster too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from operator import attrgetter
from typing import Any, TypeVar

from typing_extensions import dataclass_transform

__all__ = ["frozen"]

_Class = TypeVar("_Class", bound=type[Any])


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: _Class) -> _Class:
    """Make a slotted dataclass with equality and hash by value (a class decorator)."""
    for name, method in _SHARED.items():
        if name not in vars(cls):
            setattr(cls, name, method)
    cls.__doc__ = cls.__doc__ or cls.__name__  # dataclass would look up the signature of one without
    made: Any = dataclass(slots=True, repr=False, eq=False)(cls)
    compared = tuple(one.name for one in fields(made) if one.compare)
    made.__compared__ = attrgetter(*compared) if compared else _nothing
    return made


def _nothing(_of: object) -> tuple[()]:
    return ()


def _equal(self: Any, other: Any) -> bool:  # noqa: ANN401 - any class made here
    if self.__class__ is not other.__class__:
        return NotImplemented
    values = self.__class__.__compared__
    return values(self) == values(other)


def _hash(self: Any) -> int:  # noqa: ANN401 - as above
    return hash(self.__class__.__compared__(self))


def _shown(self: Any) -> str:  # noqa: ANN401 - as above
    values = ", ".join(f"{one.name}={getattr(self, one.name)!r}" for one in fields(self) if one.repr)
    return f"{self.__class__.__qualname__}({values})"


_SHARED = {"__eq__": _equal, "__hash__": _hash, "__repr__": _shown}
