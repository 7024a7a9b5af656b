"""This file makes HTML of parts; text is escaped unless it is markup already."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

__all__ = ["Markup", "element", "join", "table"]

_VOID = {"input", "meta", "link", "br"}


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(name: str, /, *children: str | None, **attributes: str | bool | None) -> Markup:
    """Return an element; `class_` is `class`, `_` in other attributes is `-`, None and False leave one out."""
    given = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in _VOID:
        return Markup(f"<{name}{given}>")
    return Markup(f"<{name}{given}>{join(*children)}</{name}>")


def join(*children: str | None) -> Markup:
    """Return the children one after the other; None is nothing."""
    return Markup("".join(_text(child) for child in children if child is not None))


def table(caption: str, head: tuple[str, ...], rows: Iterable[tuple[str, ...]], numbers: set[int]) -> Markup:
    """Return a table that scrolls by itself; `numbers` are the columns to align on the right."""

    def kind(column: int) -> str | None:
        return "n" if column in numbers else None

    titles = (element("th", name, scope="col", class_=kind(at)) for at, name in enumerate(head))
    lines = (
        element(
            "tr",
            element("th", row[0], scope="row"),
            *(element("td", cell, class_=kind(at)) for at, cell in enumerate(row[1:], 1)),
        )
        for row in rows
    )
    table = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *titles)),
        element("tbody", *lines),
    )
    return element("div", table, class_="table", tabindex="0", role="region", aria_label=caption)


def _text(child: str) -> str:
    return child if isinstance(child, Markup) else escape(child)


def _attribute(key: str, value: str | bool | None) -> str:  # noqa: FBT001 - HTML's own way
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escape(value)}"'
