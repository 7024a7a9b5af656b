"""This file is the process-wide registry of message types, for every recording that is opened afterwards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from enum import Enum
from pathlib import Path
from typing import ClassVar

from mosaico_ingest.bag.definition import MessageType
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.bag.schemas import read_types
from mosaico_ingest.errors import BagError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.policies import Stores
from mosaico_ingest.textfile import read_whole

__all__ = [
    "ROSTypeRegistry",
    "Registered",
    "definition_files",
    "directory_types",
    "register_source",
    "store_of",
]

_SUFFIXES = (".msg", ".idl")


@frozen
class Registered:
    """A definition text somebody gave: the type it is for, and every type it defines."""

    msgtype: str
    text: str
    types: Mapping[str, MessageType]


class ROSTypeRegistry:
    """Message types valid in this process, for all distros or for one; nothing of it needs an instance."""

    _scopes: ClassVar[dict[Stores | None, dict[str, Registered]]] = {}

    @classmethod
    def register(cls, msg_type: str, source: Path | str, store: Stores | str | None = None) -> None:
        """Announce one type: `source` is its text, or the path of a `.msg` or `.idl` file; the last one wins.

        Raises:
            BagError: The file or its text cannot be read; names the file and the line.
        """
        entry = register_source(msg_type, source)
        cls._scopes.setdefault(store_of(store), {})[entry.msgtype] = entry

    @classmethod
    def register_directory(
        cls, package_name: str, dir_path: Path | str, store: Stores | str | None = None
    ) -> None:
        """Announce every `.msg` and `.idl` file of a directory as `<package_name>/msg/<file name>`.

        Raises:
            BagError: There is no such directory, it has none of them, or one cannot be read; then none is announced.
        """
        entries = {entry.msgtype: entry for entry in directory_types(package_name, Path(dir_path))}
        cls._scopes.setdefault(store_of(store), {}).update(entries)

    @classmethod
    def get_types(cls, store: Stores | str | None = None) -> dict[str, str]:
        """Return the text of every announced type: those of all distros, overlaid by those of `store`."""
        return {name: entry.text for name, entry in cls.entries(store).items()}

    @classmethod
    def entries(cls, store: Stores | str | None = None) -> dict[str, Registered]:
        """Return what `get_types` returns, read."""
        scope = store_of(store)
        return {**cls._scopes.get(None, {}), **(cls._scopes.get(scope, {}) if scope else {})}

    @classmethod
    def snapshot(cls) -> dict[Stores | None, dict[str, Registered]]:
        """Return everything announced so far, to be restored in another process."""
        return {scope: dict(entries) for scope, entries in cls._scopes.items()}

    @classmethod
    def restore(cls, snapshot: Mapping[Stores | None, Mapping[str, Registered]]) -> None:
        """Announce what a snapshot holds, and nothing else."""
        cls._scopes.clear()
        cls._scopes.update({scope: dict(entries) for scope, entries in snapshot.items()})

    @classmethod
    def reset(cls) -> None:
        """Forget every announced type."""
        cls._scopes.clear()


def store_of(store: Stores | str | None) -> Stores | None:
    """Return the distro a name stands for.

    Raises:
        BagError: There is no such distro; names the nearest.
    """
    if store is None:
        return None
    try:
        # rosbags has an enumeration of its own
        return Stores(store.value if isinstance(store, Enum) else store)
    except ValueError:
        known = [known.value for known in Stores]
        near = get_close_matches(str(store), known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        raise BagError(f"unknown distro {store!r}", hint=hint) from None


def register_source(msg_type: str, source: Path | str) -> Registered:
    """Read one definition, from a file or as text.

    Raises:
        BagError: The file or its text cannot be read.
    """
    name = normalize_msgtype(msg_type)
    if name.count("/") != 2:  # noqa: PLR2004 - pkg/msg/Name
        raise BagError(f"{msg_type!r} is no message type", hint="write it as pkg/msg/Name")
    text, where = (source, f"definition of {name}") if _is_text(source) else _read(Path(source))
    types = dict(read_types(str(text), name, where=where))
    if name not in types:
        raise BagError(f"the text does not define {name}", where=where, hint=f"it defines {', '.join(types)}")
    return Registered(name, str(text), types)


def _is_text(source: Path | str) -> bool:
    """Say whether a source is a definition; one line that ends like a definition's file name is a path."""
    if isinstance(source, Path) or not source.endswith(_SUFFIXES) or "\n" in source:
        return isinstance(source, str)
    return len(source.split()) > 1 and not Path(source).is_file()


def _read(path: Path) -> tuple[str, str]:
    try:
        return read_whole(path).decode("utf-8-sig"), str(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise BagError(f"cannot read the definition: {reason}", where=str(path)) from error


def directory_types(package: str, path: Path) -> Iterator[Registered]:
    """Read the definitions of a package: those in a directory, in its `msg` folder, or the one a file holds.

    Raises:
        BagError: There are none, or one cannot be read.
    """
    files = definition_files(path)
    if not files:
        there = "has no .msg or .idl file" if path.is_dir() else "does not exist"
        raise BagError(
            f"{path} {there}",
            where=f"messages of {package}",
            hint="give a directory of .msg files or one file",
        )
    for file in files:
        yield register_source(f"{package.removesuffix('/msg')}/msg/{file.stem}", file)


def definition_files(path: Path) -> list[Path]:
    """Return the definition files of a directory, of its `msg` folder, or the one file itself."""
    if path.is_file():
        return [path]
    for folder in (path, path / "msg"):
        if folder.is_dir():
            files = sorted(file for file in folder.iterdir() if file.suffix in _SUFFIXES)
            if files:
                return files
    return []
