"""Tables for notebooks: the HTML that `_repr_html_` of reports, plans, sequences, topics and stores returns."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from html import escape
from itertools import islice

MAX_ROWS = 100
"""Rows of a table; the last line states how many there are."""


def html_table(
    caption: str,
    names: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    count: int,
    numbers: Collection[str] = (),
    notes: Sequence[str] = (),
) -> str:
    """Return a table of escaped text with at most `MAX_ROWS` of `count` rows; columns in `numbers` are right-aligned."""
    aligned = [
        " style='text-align:right'" if name in numbers else " style='text-align:left'" for name in names
    ]
    head = "".join(f"<th{style}>{escape(name)}</th>" for name, style in zip(names, aligned, strict=True))
    body = "".join(
        "<tr>"
        + "".join(f"<td{style}>{escape(cell)}</td>" for cell, style in zip(row, aligned, strict=True))
        + "</tr>"
        for row in islice(rows, MAX_ROWS)
    )
    more = [f"… and {count - MAX_ROWS:,} more"] if count > MAX_ROWS else []
    lines = "".join(f"<p>{escape(line)}</p>" for line in (*more, *notes))
    title = f"<caption style='text-align:left'><b>{escape(caption)}</b></caption>"
    return f"<table>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{lines}"
