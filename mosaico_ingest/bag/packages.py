"""This file is the message types of public packages that no distro's core has, for recordings without definitions.

`packages/` holds the fields of each package as its public repository declares them; licences are in `packages/README.md`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path

from mosaico_ingest.bag.definition import MessageType
from mosaico_ingest.bag.schemas import read_types

__all__ = ["package_type"]

_FOLDER = Path(__file__).parent / "packages"


def package_type(name: str) -> MessageType | None:
    """Return a ROS 2 type by full name, None where no known package has it."""
    return _types(name.partition("/")[0]).get(name)


@cache
def _known() -> frozenset[str]:
    return frozenset(path.stem for path in _FOLDER.glob("*.txt"))


@cache
def _types(package: str) -> Mapping[str, MessageType]:
    if package not in _known():
        return {}
    path = _FOLDER / f"{package}.txt"
    return read_types(path.read_text(encoding="utf-8"), package, where=str(path))
