"""The files of a recording: a file, a directory, or splits with their `metadata.yaml`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from mosaico_ingest.errors import BagError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.opening import is_recording
from mosaico_ingest.textfile import read_limited

__all__ = [
    "FILE_NAME",
    "Metadata",
    "MetadataTopic",
    "RecordingFiles",
    "discover",
    "read_metadata",
]

FILE_NAME = "metadata.yaml"
_LIMIT_BYTES = 16 << 20


class MetadataTopic(Struct, frozen=True):
    """What the metadata say of a topic."""

    topic: str
    msgtype: str
    count: int
    serialization_format: str
    qos: str
    """As the storage spells it; empty where this version of the metadata has another form."""


class Metadata(Struct, frozen=True):
    """The parts of `metadata.yaml` that can be compared with the storage."""

    path: AnyPath
    files: tuple[str, ...]
    message_count: int
    topics: tuple[MetadataTopic, ...]
    distro: str


def read_metadata(path: AnyPath) -> Metadata:
    """Read a `metadata.yaml` of any version.

    Raises:
        BagError: It is no YAML, or not of rosbag2's shape.
    """
    import yaml  # noqa: PLC0415 - slow to import, and few recordings come with metadata

    try:
        if path.stat().st_size > _LIMIT_BYTES:
            raise BagError(f"larger than {_LIMIT_BYTES} bytes", where=str(path))
        content = yaml.load(read_limited(path), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # noqa: S506 - both are safe loaders, one is fast
        info = content["rosbag2_bagfile_information"]
        return Metadata(
            path,
            tuple(_text(name) for name in info.get("relative_file_paths") or ()),
            int(info.get("message_count") or 0),
            tuple(_topic(entry) for entry in info.get("topics_with_message_count") or ()),
            _text(info.get("ros_distro")),
        )
    except OSError as err:
        raise BagError(f"cannot be read: {err.strerror}", where=str(path)) from err
    except yaml.YAMLError as err:
        raise BagError(f"no YAML: {' '.join(str(err).split())}", where=str(path)) from err
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as err:
        raise BagError(f"not of the shape of rosbag2's metadata: {err}", where=str(path)) from err


def _topic(entry: dict[str, Any]) -> MetadataTopic:
    about = entry.get("topic_metadata") or entry["topic_and_type"]
    qos = about.get("offered_qos_profiles")
    return MetadataTopic(
        _text(about["name"]),
        _text(about["type"]),
        int(entry.get("message_count") or 0),
        _text(about.get("serialization_format")),
        qos if isinstance(qos, str) else "",
    )


def _text(value: object) -> str:
    """Return a scalar as text; a list would be spelled out with all that its aliases stand for."""
    if value is None or isinstance(value, (str, int, float)):
        return "" if value is None else str(value)
    raise ValueError(f"a text expected, a {type(value).__name__} found")


_SUFFIX = ".zstd"
_NAMED = (".bag", ".db3", ".mcap")


class RecordingFiles(Struct, frozen=True):
    """The files of one recording, the metadata that describe all of them, and what is odd about either."""

    files: tuple[AnyPath, ...]
    metadata: Metadata | None
    findings: tuple[Finding, ...]
    missing: tuple[AnyPath, ...] = ()
    """Parts that the metadata list beside others that are there."""


def discover(paths: Sequence[AnyPath]) -> RecordingFiles:
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
    return RecordingFiles(files, found[0].metadata if len(found) == 1 else None, findings, missing)


def _one(path: AnyPath) -> RecordingFiles:
    if not path.exists():
        raise BagError("does not exist", where=str(path), hint="check the path")
    if path.is_dir():
        return _directory(path)
    if path.name == FILE_NAME:
        return _listed(read_metadata(path))
    return _file(path)


def _file(path: AnyPath) -> RecordingFiles:
    """A file is itself; the metadata beside it count where they speak of this file alone."""
    beside = path.parent / FILE_NAME
    if not beside.is_file():
        return RecordingFiles((path,), None, ())
    try:
        metadata = read_metadata(beside)
    except BagError as err:
        return RecordingFiles((path,), None, (_unreadable(err),))
    names = [Path(name).name for name in metadata.files]
    if not {path.name, path.name.removesuffix(_SUFFIX)} & set(names):
        return RecordingFiles((path,), None, ())
    if len(names) == 1:
        return RecordingFiles((path,), metadata, ())
    part = Finding(
        "single-split",
        Severity.INFO,
        f"{path.name} is one of the {len(names)} parts that {beside} lists",
        help=f"name {path.parent} to read all of them",
    )
    return RecordingFiles((path,), None, (part,))


def _directory(path: AnyPath) -> RecordingFiles:
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
    return RecordingFiles(tuple(files), None, findings)


def _listed(metadata: Metadata) -> RecordingFiles:
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
    unlisted = _unlisted_splits(folder, files)
    files += unlisted
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
            "missing-split",
            Severity.WARNING,
            f"{metadata.path} lists {name}, which is not there",
            help="restore it, or accept that its messages are missing",
        )
        for name in missing
    )
    findings += tuple(
        Finding(
            "metadata-differs",
            Severity.INFO,
            f"{metadata.path}: {file.name} is not listed, and is read as a split of the recording",
            help="the metadata may be truncated; check it",
        )
        for file in unlisted
    )
    return RecordingFiles(tuple(sorted(files, key=_natural) if unlisted else files), metadata, findings, gone)


_SPLIT_NAME = re.compile(r"(?P<stem>.*)_\d+(?P<suffix>\.(?:db3|mcap)(?:\.zstd)?)")


def _unlisted_splits(folder: AnyPath, files: Sequence[AnyPath]) -> list[AnyPath]:
    """Return the recordings that are named like the listed splits: truncated metadata lists only the first ones."""
    names = {match.groups() for file in files if (match := _SPLIT_NAME.fullmatch(file.name))}
    return [
        file
        for file in (_recordings(folder) if names else ())
        if file not in files and (match := _SPLIT_NAME.fullmatch(file.name)) and match.groups() in names
    ]


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
    return [
        (int(extent), "") if extent.isdecimal() else (-1, extent) for extent in re.split(r"(\d+)", path.name)
    ]


def _unreadable(err: BagError) -> Finding:
    return Finding(
        "metadata-unreadable", Severity.WARNING, str(err), help="the storage alone decides what is read"
    )
