"""This file decides what a text is: a job, an adapter, a message definition, or none of our business."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from functools import partial
from itertools import takewhile
from pathlib import Path

from mosaico_ingest.frozen import frozen
from mosaico_ingest.lint.suppress import MARKER

__all__ = ["Document", "Kind", "documents_in", "kind_of"]

_JOB = re.compile(r"^(bag|\"bag\"|'bag'|extends) *:|^ *\{ *\"?(bag|extends)\"? *:", re.MULTILINE)
_ADAPTER = re.compile(r"^(adapter|ros_type|variants) *:", re.MULTILINE)
_NAMED = re.compile(r"^adapter *:", re.MULTILINE)
_FENCE = re.compile(r"^(?P<indent> *)(?P<fence>```+|~~~+) *(?P<language>\w*)[^\n]*$")


class Kind(str, Enum):
    """What a text is judged as."""

    JOB = "job"
    ADAPTER = "adapter"
    MESSAGE = "message"


@frozen
class Document:
    """A text to judge."""

    file: str
    """The name to show."""
    text: str
    kind: Kind
    folder: Path
    """Where its relative paths start."""
    path: Path | None = None
    """The file on disk, if it is one of its own."""
    example: bool = False
    """Whether it is an example on a page, so that nothing beside it has to be there."""


def kind_of(text: str, *, suffix: str = ".yaml") -> Kind | None:
    """Return what a text looks like; None if it is neither a job nor an adapter nor a definition."""
    if suffix == ".msg":
        return Kind.MESSAGE
    if _JOB.search(text):
        return Kind.JOB
    return Kind.ADAPTER if _ADAPTER.search(text) else None


def documents_in(text: str, *, file: str, path: Path | None, folder: Path, named: bool) -> Iterator[Document]:
    """Yield what a file holds: itself, or the YAML blocks of a Markdown page that are jobs or adapters.

    A file that was `named` is a job unless it looks like something else.
    """
    suffix = Path(file).suffix.lower()
    if suffix in {".md", ".markdown"}:
        for block in _blocks(text):
            kind = kind_of(block)
            whole = kind is not Kind.ADAPTER or _NAMED.search(block) is not None
            if kind is not None and whole and f"{MARKER} skip" not in block:
                yield Document(file, block, kind, folder, example=True)
        return
    kind = kind_of(text, suffix=suffix) or (Kind.JOB if named else None)
    if kind is not None:
        yield Document(file, text, kind, folder, path)


def _blocks(text: str) -> Iterator[str]:
    """Yield the YAML blocks of a Markdown text, each below as many empty lines as there are above it."""
    lines = iter(enumerate(text.splitlines()))
    for number, line in lines:
        opening = _FENCE.match(line)
        if opening is None:
            continue
        inside = takewhile(partial(_is_inside, opening["fence"]), lines)
        block = [inner for _, inner in inside]
        if opening["language"].lower() in {"yaml", "yml"}:
            yield "\n" * (number + 1) + "\n".join(block) + "\n"


def _is_inside(fence: str, numbered: tuple[int, str]) -> bool:
    return numbered[1].strip() != fence
