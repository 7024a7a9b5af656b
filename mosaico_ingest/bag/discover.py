"""This file finds the files that a path stands for: a file, a directory, a split recording with its metadata."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from mosaico_ingest.bag.containers.opening import is_recording
from mosaico_ingest.bag.metadata import FILE_NAME, Metadata, read_metadata
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.errors import BagError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath

__all__ = ["Found", "discover"]

_SUFFIX = ".zstd"
_NAMED = (".bag", ".db3", ".mcap")


@frozen
class Found:
    """The files of one recording, the metadata that describe all of them, and what is odd about either."""

    files: tuple[AnyPath, ...]
    metadata: Metadata | None
    findings: tuple[Finding, ...]
    missing: tuple[AnyPath, ...] = ()
    """Parts that the metadata list beside others that are there."""


def discover(paths: Sequence[AnyPath]) -> Found:
    """Return the files that `paths` stand for, each once.

    Raises:
        BagError: A path does not exist, or holds no recording.
    """
    if not paths:
        raise BagError("no path given", hint="name a recording, a directory or a metadata.yaml")
    found = [_one(path) for path in paths]
    files = tuple(dict.fromkeys(file for one in found for file in one.files))
    findings = tuple(finding for one in found for finding in one.findings)
    missing = tuple(file for one in found for file in one.missing)
    return Found(files, found[0].metadata if len(found) == 1 else None, findings, missing)


def _one(path: AnyPath) -> Found:
    if not path.exists():
        raise BagError("does not exist", where=str(path), hint="check the path")
    if path.is_dir():
        return _directory(path)
    if path.name == FILE_NAME:
        return _listed(read_metadata(path))
    return _file(path)


def _file(path: AnyPath) -> Found:
    """A file is itself; the metadata beside it count where they speak of this file alone."""
    beside = path.parent / FILE_NAME
    if not beside.is_file():
        return Found((path,), None, ())
    try:
        metadata = read_metadata(beside)
    except BagError as err:
        return Found((path,), None, (_unreadable(err),))
    names = [Path(name).name for name in metadata.files]
    if not {path.name, path.name.removesuffix(_SUFFIX)} & set(names):
        return Found((path,), None, ())
    if len(names) == 1:
        return Found((path,), metadata, ())
    part = Finding(
        "part-of-recording",
        Severity.INFO,
        f"{path.name} is one of the {len(names)} parts that {beside} lists",
        help=f"name {path.parent} to read all of them",
    )
    return Found((path,), None, (part,))


def _directory(path: AnyPath) -> Found:
    listing = path / FILE_NAME
    findings: tuple[Finding, ...] = ()
    if listing.is_file():
        try:
            metadata = read_metadata(listing)
        except BagError as err:
            findings = (_unreadable(err),)
        else:
            return _listed(metadata)
    files = _recordings(path)
    if not files:
        held = ", ".join(sorted(entry.name for entry in _entries(path))[:5])
        raise BagError(
            f"a directory without a recording; it holds {held or 'nothing'}",
            where=str(path),
            hint="name a .bag, .db3 or .mcap file, or a directory with a metadata.yaml",
        )
    return Found(tuple(files), None, findings)


def _listed(metadata: Metadata) -> Found:
    folder = metadata.path.parent
    files: list[AnyPath] = []
    missing: list[str] = []
    for name in metadata.files:
        file = next((file for file in _candidates(folder, name) if file.is_file()), None)
        if file is None:
            missing.append(name)
        else:
            files.append(file)
    gone = tuple(folder / name for name in missing) if files else ()
    if not files:
        files = _recordings(folder)
        if not files:
            raise BagError(
                f"none of the files it lists is there: {', '.join(metadata.files) or 'it lists none'}",
                where=str(metadata.path),
                hint="restore the files beside it",
            )
    findings = tuple(
        Finding(
            "missing-part",
            Severity.WARNING,
            f"{metadata.path} lists {name}, which is not there",
            help="restore it, or accept that its messages are missing",
        )
        for name in missing
    )
    return Found(tuple(files), metadata, findings, gone)


def _recordings(folder: AnyPath) -> list[AnyPath]:
    """Return what is a recording, and what is only called so: a part that is empty or damaged is a loss, not nothing.

    Hidden files are no parts: copying programs leave them.
    """
    files = (entry for entry in _entries(folder) if entry.is_file() and not entry.name.startswith("."))
    return sorted((file for file in files if _is_named(file) or is_recording(file)), key=_natural)


def _is_named(file: AnyPath) -> bool:
    return file.name.removesuffix(_SUFFIX).endswith(_NAMED)


def _entries(folder: AnyPath) -> list[AnyPath]:
    try:
        return list(folder.iterdir())
    except OSError as err:
        raise BagError(f"cannot be listed: {err.strerror}", where=str(folder)) from err


def _candidates(folder: AnyPath, name: str) -> Iterator[AnyPath]:
    """Yield where a listed file may be: old versions wrote a directory, or left off the compression's suffix."""
    for part in dict.fromkeys((name, Path(name).name)):
        yield folder / part
        yield folder / f"{part}{_SUFFIX}"
        yield folder / part.removesuffix(_SUFFIX)


def _natural(path: AnyPath) -> list[tuple[int, str]]:
    """Sort `part_10` behind `part_9`."""
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", path.name)]


def _unreadable(err: BagError) -> Finding:
    return Finding(
        "metadata-unreadable", Severity.WARNING, str(err), help="the storage alone decides what is read"
    )
