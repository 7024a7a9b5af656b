"""Generate the table of functions in docs/mapping.md from the docstrings of the functions."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.adapters.mapping.functions import SUBJECTS, functions, operators

_BEGIN, _END = "<!-- functions: generated from their docstrings -->\n", "<!-- end of functions -->\n"
_SPECIAL = (
    (
        "cast(x)",
        "x in the type of its column; a value out of range, or a fraction for an integer, rejects the row",
    ),
    (
        "cast(x, 'type')",
        "x as bool, int8 … int64, uint8 … uint64, float16, float32 or float64, with the same checks",
    ),
    (
        "either(a, b, …)",
        "the first argument whose fields all exist in the message type: `either(d, D)`, `either(seq, null)`",
    ),
    ("if_else(c, a, b)", "`a if c else b`"),
)


def function_reference() -> str:
    """Return Markdown tables of all functions, one per subject."""
    return "\n".join(_tables())


def with_reference(text: str) -> str:
    """Return a document with the table between its two markers regenerated."""
    before, rest = text.split(_BEGIN)
    after = rest.split(_END)[1]
    return f"{before}{_BEGIN}\n{function_reference()}\n{_END}{after}"


def _tables() -> Iterator[str]:
    yield _table("Types and branches", _SPECIAL)
    for subject in SUBJECTS:
        if subject is operators:
            continue
        rows = [(f.signature, f.summary) for f in functions() if f.apply.__module__ == subject.__name__]
        title = (subject.__doc__ or "").rstrip(".")
        yield _table(title[:1].upper() + title[1:], rows)


def _table(title: str, rows: list[tuple[str, str]] | tuple[tuple[str, str], ...]) -> str:
    body = "".join(f"| `{signature}` | {summary.rstrip('.')} |\n" for signature, summary in rows)
    return f"**{title}**\n\n| function | result |\n|---|---|\n{body}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_reference(path.read_text("utf-8")), "utf-8")
