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
        at: int | None = 0
        while at is not None:
            begin = at
            try:
                for row in self._from(at):
                    at = row[0] + 1
                    yield row
            except BROKEN as err:
                at = self._next_readable(max(begin, at))
                upto = "the end" if at is None else f"row {at}"
                self.holes.append(Hole(max(begin, at or 0), f"{err}: rows are missing before {upto}"))
            else:
                return

    def _from(self, rowid: int, limit: int = -1) -> Iterator[Row]:
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED "
            "WHERE rowid >= ? ORDER BY rowid LIMIT ?"
        )
        yield from self.connection.execute(query, (rowid, limit))

    def _next_readable(self, broken: int) -> int | None:
        """Return the first row id behind `broken` from which rows can be read: by doubling steps, then halving."""
        step, low = 1, broken
        while not self._is_readable(low + step):
            low, step = low + step, step * 2
            if low + step > _LAST_ROWID:
                return None
        high = low + step
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_readable(middle) else (middle, high)
        return high

    def _is_readable(self, rowid: int) -> bool:
        try:
            list(self._from(rowid, 1))
        except BROKEN:
            return False
        return True
