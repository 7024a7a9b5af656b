"""A `.msg` file as the rules see it, and the definitions available without a recording."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from msgspec import Struct

from mosaico_ingest.findings import Span
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.distros import distro_type
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype

__all__ = [
    "Declaration",
    "MessageFile",
    "is_known",
    "read_message",
]

_SUFFIXES = (".msg", ".idl")


def is_known(kind: str, path: Path | None) -> bool:
    """Say whether a field's type is defined beside the file at `path`, in a package next to it, or by a distro."""
    package, _, name = kind.rpartition("/")
    if path is not None:
        package = package.removesuffix("/msg")
        folders = [path.parent] if not package else _package_folders(path.parent, package)
        if any((folder / f"{name}{suffix}").is_file() for folder in folders for suffix in _SUFFIXES):
            return True
    return bool(package) and _in_distro(normalize_msgtype(kind))


def _package_folders(folder: Path, package: str) -> list[Path]:
    """Return where a package's definitions may lie, seen from the folder of another one's."""
    bases = [folder.parent, folder.parent.parent]
    here = [folder] if package in {folder.name, folder.parent.name} else []
    return here + [base / package / inner for base in bases for inner in ("", "msg")]


@cache
def _in_distro(name: str) -> bool:
    return any(distro_type(distro, name) is not None for distro in reversed(Stores))


_DECLARATION = re.compile(
    r"\s*(?P<type>[A-Za-z]\w*(?:/\w+)*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>\w+)\s*(?P<rest>.*)"
)


class Declaration(Struct, frozen=True):
    """One line: a field or a constant."""

    type: str
    name: str
    constant: bool
    value: str
    type_span: Span
    name_span: Span


class MessageFile(Struct, frozen=True):
    """A definition text."""

    file: str
    text: str
    declarations: tuple[Declaration, ...]
    path: Path | None = None
    """The file on disk, if there is one."""

    @property
    def name(self) -> str:
        """The type's own name: the file's, without `.msg`."""
        return Path(self.file).stem

    def lines(self) -> Iterator[tuple[Span, str]]:
        """Yield every line that is not blank, with its place."""
        for number, line in enumerate(self.text.splitlines(), 1):
            if line.strip():
                start = len(line) - len(line.lstrip()) + 1
                yield Span(self.file, number, start, number, len(line.rstrip()) + 1), line


def read_message(text: str, *, file: str, path: Path | None = None) -> MessageFile:
    """Read a definition; never raises."""
    matches = (
        (number, _DECLARATION.fullmatch(_code(line))) for number, line in enumerate(text.splitlines(), 1)
    )
    declarations = (_declaration(match, file, number) for number, match in matches if match is not None)
    return MessageFile(file, text, tuple(declarations), path)


def _code(line: str) -> str:
    """Return a line without its comment; a constant's text may hold a `#`."""
    before = line.split("#", 1)[0]
    return (line if "=" in before else before).rstrip()


def _declaration(match: re.Match[str], file: str, number: int) -> Declaration:
    def span(group: str) -> Span:
        return Span(file, number, match.start(group) + 1, number, match.end(group) + 1)

    rest = match["rest"]
    constant = rest.startswith("=")
    value = rest.removeprefix("=").strip()
    return Declaration(match["type"], match["name"], constant, value, span("type"), span("name"))
