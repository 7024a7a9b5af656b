"""This file reads the rows of a damaged SQLite file that can still be reached, by stepping over what cannot."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from mosaico_ingest.bag.containers.part import Hole

__all__ = ["BROKEN", "Row", "Salvage"]

BROKEN = (sqlite3.Error, UnicodeDecodeError)
"""How damage shows; the second, where SQLite's message quotes a name that is damaged."""

Row = tuple[int, int, int, Any]
"""Row id, topic id, time stamp, payload; what SQLite keeps in the last column need not be bytes."""
_LAST_ROWID = 2**63 - 1


@dataclass(slots=True)
class Salvage:
    """Rows by row id instead of by time; what had to be stepped over is in `holes`."""

    connection: sqlite3.Connection
    holes: list[Hole] = field(default_factory=list[Hole])

    def rows(self) -> Iterator[Row]:
        """Yield every row that can be read."""
        at = 0
        while True:
            try:
                for row in self._from(at):
                    at = max(at, row[0] + 1)
                    yield row
            except BROKEN as err:  # noqa: PERF203 - each stretch may end in damage of its own
                found = self._next_row(at)
                upto = "the end" if found is None else f"row {found[0]}"
                if found is None or found[0] > at:
                    self.holes.append(Hole(at, f"{err}: rows are missing before {upto}"))
                if found is None:
                    return
                yield found  # by itself: where the row behind it is damaged, a query for both may give neither
                at = found[0] + 1
            else:
                return

    def _from(self, rowid: int, limit: int = -1) -> Iterator[Row]:
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED "
            "WHERE rowid >= ? ORDER BY rowid LIMIT ?"
        )
        yield from self.connection.execute(query, (rowid, limit))

    def _next_row(self, broken: int) -> Row | None:
        """Return the first row from `broken` on that can be read, None without any: by doubling steps, then halving."""
        step, low, high = 1, broken - 1, broken
        while not self._is_readable(high):
            low, high, step = high, high + step, step * 2
            if high > _LAST_ROWID:
                return None
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_readable(middle) else (middle, high)
        found = next(self._from(high, 1), None)
        return found if found is not None and found[0] >= broken else None

    def _is_readable(self, rowid: int) -> bool:
        try:
            list(self._from(rowid, 1))
        except BROKEN:
            return False
        return True
