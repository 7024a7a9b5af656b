"""The display of `ingest adapters try`: messages and their rows side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from typing import Any

from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal, print_line
from mosaico_ingest.report.units import counted, time_text
from mosaico_ingest.services.adapters import TriedMessage

_MAX_ITEMS = 4
"""Number of elements of a list that are shown."""
_MAX_STRUCTS = 2
"""Number of messages in a list that are shown."""
_MAX_TEXT = 60
"""Number of characters of a text that are shown."""


def print_trial(tried: Sequence[TriedMessage]) -> None:
    """Print each message with its rows."""
    for one in tried:
        rows = sum(len(of_output) for of_output in one.rows.values())
        print_line(f"message {one.index}, {time_text(one.log_time_ns)}: {counted(rows, 'row')}", style="bold")
        table = PlainTable("message", "value", "column", "row")
        left = list(_lines(one.message, ""))
        right = [line for name, of_output in one.rows.items() for line in _row_lines(name, of_output)]
        for (path, value), (column, stored) in zip_longest(left, right, fillvalue=("", "")):
            table.add_row(Text(path, style="dim"), value, Text(column, style="dim"), stored)
        Terminal().print(table)
        if one.rejected is not None:
            print_line(f"rejected {one.rejected}", style="red")
        if one.dropped is not None:
            print_line(f"dropped by `{one.dropped}`", style="yellow")
    rejected = sum(one.rejected is not None for one in tried)
    dropped = sum(one.dropped is not None for one in tried)
    line = f"{counted(len(tried), 'message')}: {len(tried) - rejected - dropped} written"
    print_line(f"{line}, {dropped} dropped, {rejected} rejected", style="red" if rejected else "green")


def _row_lines(output: str, rows: Sequence[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    for number, row in enumerate(rows):
        title = f"{output} {number + 1}".strip() if output or len(rows) > 1 else ""
        if title:
            yield f"{title}:", ""
        yield from _lines(row, "  " if title else "")


def _lines(values: dict[str, Any], prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the path and the value of each field; long lists and texts are shortened."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _lines(value, f"{prefix}{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for at, item in enumerate(value[:_MAX_STRUCTS]):
                yield from _lines(item or {}, f"{prefix}{name}[{at}].")
            if len(value) > _MAX_STRUCTS:
                yield f"{prefix}{name}", f"… {len(value)} elements"
        else:
            yield f"{prefix}{name}", _text(value)


def _text(value: Any) -> str:  # noqa: ANN401 - a value of a message or row
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, list):
        items = ", ".join(_text(item) for item in value[:_MAX_ITEMS])
        return f"[{items}]" if len(value) <= _MAX_ITEMS else f"[{items}, … {len(value)} elements]"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = "null" if value is None else str(value)
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…"
