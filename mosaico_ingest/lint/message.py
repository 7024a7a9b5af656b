"""A `.msg` file as the checks see it, and the types that its fields may refer to."""

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

_SUFFIXES = (".msg", ".idl")
_DECLARATION = re.compile(
    r"\s*(?P<type>[A-Za-z]\w*(?:/\w+)*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>\w+)\s*(?P<rest>.*)"
)


class Declaration(Struct, frozen=True):
    """One line of a definition: a field or a constant."""

    type: str
    name: str
    is_constant: bool
    type_span: Span
    name_span: Span


class MessageFile(Struct, frozen=True):
    """The text of a message definition."""

    file: str
    text: str
    declarations: tuple[Declaration, ...]
    path: Path | None = None
    """The file that contains the text, or None."""

    @property
    def name(self) -> str:
        """The name of the type: the file name without `.msg`."""
        return Path(self.file).stem

    def lines(self) -> Iterator[tuple[Span, str]]:
        """Yield every line that is not blank, with its span."""
        for number, line in enumerate(self.text.splitlines(), 1):
            if line.strip():
                start = len(line) - len(line.lstrip()) + 1
                yield Span(self.file, number, start, number, len(line.rstrip()) + 1), line


def read_message(text: str, *, file: str, path: Path | None = None) -> MessageFile:
    """Return the declarations of a definition. Lines that are not declarations are skipped."""
    declarations = [
        _declaration(match, file, number)
        for number, line in enumerate(text.splitlines(), 1)
        if (match := _DECLARATION.fullmatch(_without_comment(line)))
    ]
    return MessageFile(file, text, tuple(declarations), path)


def is_defined(msgtype: str, path: Path | None) -> bool:
    """Return whether a type is defined next to the file at `path`, in a neighboring package, or in a ROS distribution."""
    package, _, name = msgtype.rpartition("/")
    if path is not None:
        package = package.removesuffix("/msg")
        folders = [path.parent] if not package else _package_folders(path.parent, package)
        if any((folder / f"{name}{suffix}").is_file() for folder in folders for suffix in _SUFFIXES):
            return True
    return bool(package) and _is_in_distro(normalize_msgtype(msgtype))


def _package_folders(folder: Path, package: str) -> list[Path]:
    """Return the folders that may contain the definitions of a package, given a folder that refers to it."""
    own = [folder] if package in {folder.name, folder.parent.name} else []
    parents = [folder.parent, folder.parent.parent]
    return own + [parent / package / inner for parent in parents for inner in ("", "msg")]


@cache
def _is_in_distro(msgtype: str) -> bool:
    return any(distro_type(distro, msgtype) is not None for distro in reversed(Stores))


def _without_comment(line: str) -> str:
    """Return a line without its comment. The value of a string constant may contain a `#`."""
    before = line.split("#", 1)[0]
    return (line if "=" in before else before).rstrip()


def _declaration(match: re.Match[str], file: str, number: int) -> Declaration:
    def span(group: str) -> Span:
        return Span(file, number, match.start(group) + 1, number, match.end(group) + 1)

    return Declaration(
        match["type"], match["name"], match["rest"].startswith("="), span("type"), span("name")
    )
