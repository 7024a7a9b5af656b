"""This file looks message definitions up: on disk beside each other, and in the distros."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from mosaico_ingest.bag.distros import distro_type
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.policies import Stores

__all__ = ["is_known"]

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
