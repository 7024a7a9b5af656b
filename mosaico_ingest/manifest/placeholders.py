"""This file knows the placeholders of `sequence.name`: which there are, and where they stand in a name."""

from __future__ import annotations

import re
from collections.abc import Iterator

from mosaico_ingest.frozen import frozen

__all__ = ["PLACEHOLDERS", "Placeholder", "placeholders_in"]

PLACEHOLDERS = ("stem", "name", "parent", "date", "index")

_WIDTH = re.compile(r"0?[0-9]")
_BRACED = re.compile(r"\{([^{}]*)\}")


@frozen
class Placeholder:
    """`{index:03}` at `start:end` of a name."""

    start: int
    end: int
    name: str
    width: str

    @property
    def known(self) -> bool:
        """Whether something can stand for it; only `index` has a width."""
        return self.name in PLACEHOLDERS and (
            not self.width or (self.name == "index" and _WIDTH.fullmatch(self.width) is not None)
        )


def placeholders_in(template: str) -> Iterator[Placeholder]:
    """Yield what stands in braces."""
    for match in _BRACED.finditer(template):
        name, _, width = match[1].partition(":")
        yield Placeholder(match.start(), match.end(), name, width)
