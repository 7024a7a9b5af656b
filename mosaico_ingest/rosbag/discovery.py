"""The files of a recording: a file, a directory, or splits with their `metadata.yaml`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from mosaico_ingest.containers import SUFFIX_LIST, SUFFIXES, ZSTD_SUFFIX
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import BagError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.opening import is_recording

FILE_NAME = "metadata.yaml"
_NO_CUSTOM_DATA = re.compile(r"^ *custom_data: *(~|null|\{\}) *$", re.MULTILINE)
_TOP_KEY = "rosbag2_bagfile_information"
_MAX_BYTES = 16 << 20
_SPLIT_NAME = re.compile(
    rf"(?P<stem>.*)_\d+(?P<suffix>(?:{'|'.join(map(re.escape, SUFFIXES))})(?:{re.escape(ZSTD_SUFFIX)})?)"
)
"""The file name of a numbered split."""


class MetadataTopic(Struct, frozen=True):
    """The entry of a topic in the metadata."""

    topic: str
    msgtype: str
    count: int
    serialization_format: str
    qos: str
    """The QoS profiles as text; empty if this version of the metadata stores them in another form."""


class Metadata(Struct, frozen=True):
    """The content of a `metadata.yaml` that can be compared with the files."""

    path: AnyPath
    files: tuple[str, ...]
    message_count: int
    topics: tuple[MetadataTopic, ...]
    distro: str
    custom_data: Mapping[str, str] = {}
    """Texts that the user of the recorder added."""


def read_metadata(path: AnyPath) -> Metadata:
    """Read a `metadata.yaml` of any version.

    Raises:
        BagError: The file is not YAML, or does not have the structure of rosbag2's metadata.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BagError(f"larger than {_MAX_BYTES} bytes", where=str(path))
        return parse_metadata(read_limited(path), path)
    except OSError as err:
        raise BagError(f"cannot be read: {err.strerror}", where=str(path)) from err


def parse_metadata(content: bytes | str, path: AnyPath, *, is_embedded: bool = False) -> Metadata:
    """Parse the text of a `metadata.yaml` of any version; the copy embedded in MCAP files may lack the top-level key.

    Raises:
        BagError: The text is not YAML, or does not have the structure of rosbag2's metadata.
    """
    import yaml  # noqa: PLC0415 - slow to import, and few recordings come with metadata

    try:
        document = yaml.load(content, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # noqa: S506 - both are safe loaders, one is fast
        info = document if is_embedded and _TOP_KEY not in document else document[_TOP_KEY]
        return Metadata(
            path,
            tuple(_text(name) for name in info.get("relative_file_paths") or ()),
            int(info.get("message_count") or 0),
            tuple(_topic(entry) for entry in info.get("topics_with_message_count") or ()),
            _text(info.get("ros_distro")),
            _texts(info.get("custom_data")),
        )
    except yaml.YAMLError as err:
        raise BagError(f"not valid YAML: {' '.join(str(err).split())}", where=str(path)) from err
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as err:
        raise BagError(f"does not have the structure of rosbag2's metadata: {err}", where=str(path)) from err


def may_have_custom_data(text: str) -> bool:
    """Return False if the text of a `metadata.yaml` has no custom data, which rosbag2 writes as null.

    Most recordings have none, and importing the YAML parser takes longer than planning them.
    """
    return "custom_data" in _NO_CUSTOM_DATA.sub("", text)


def _topic(entry: dict[str, Any]) -> MetadataTopic:
    topic = entry.get("topic_metadata") or entry["topic_and_type"]
    qos = topic.get("offered_qos_profiles")
    return MetadataTopic(
        _text(topic["name"]),
        _text(topic["type"]),
        int(entry.get("message_count") or 0),
        _text(topic.get("serialization_format")),
        qos if isinstance(qos, str) else "",
    )


def _texts(value: object) -> dict[str, str]:
    """Return the scalars of a mapping as texts; empty for other values."""
    scalars = (str, int, float)
    items = value.items() if isinstance(value, dict) else ()
    return {str(key): _text(item) for key, item in items if item is None or isinstance(item, scalars)}


def _text(value: object) -> str:
    """Return a scalar as text. A list is refused, because formatting it would expand all of its aliases."""
    if value is None or isinstance(value, (str, int, float)):
        return "" if value is None else str(value)
    raise ValueError(f"a string expected, a {type(value).__name__} found")


class RecordingFiles(Struct, frozen=True):
    """The files of one recording, the metadata that describes all of them, and findings about both."""

    files: tuple[AnyPath, ...]
    metadata: Metadata | None
    findings: tuple[Finding, ...]
    missing: tuple[AnyPath, ...] = ()
    """Splits that the metadata lists and that do not exist, if others do."""


def discover(paths: Sequence[AnyPath]) -> RecordingFiles:
    """Return the files of the recording at `paths`: files, directories or `metadata.yaml` files. Deduplicate them.

    Raises:
        BagError: A path does not exist, or contains no recording.
    """
    if not paths:
        raise BagError("no path given", hint="name a recording, a directory or a metadata.yaml")
    parts = [_discover_path(path) for path in paths]
    files = tuple(dict.fromkeys(file for part in parts for file in part.files))
    findings = tuple(finding for part in parts for finding in part.findings)
    missing = tuple(file for part in parts for file in part.missing)
    return RecordingFiles(files, parts[0].metadata if len(parts) == 1 else None, findings, missing)


def recording_files(path: AnyPath) -> list[AnyPath]:
    """Return the recordings in a folder without a `metadata.yaml`; for any other path, the path itself."""
    if not path.is_dir() or (path / FILE_NAME).is_file():
        return [path]
    return _recordings(path) or [path]


def _discover_path(path: AnyPath) -> RecordingFiles:
    if not path.exists():
        raise BagError("does not exist", where=str(path), hint="check the path")
    if path.is_dir():
        return _discover_directory(path)
    if path.name == FILE_NAME:
        return _discover_listed(read_metadata(path))
    return _discover_file(path)


def _discover_file(path: AnyPath) -> RecordingFiles:
    """Return a single file, with the metadata next to it if it describes only this file."""
    if isinstance(path, RemotePath) and path.is_web:
        return RecordingFiles((path,), None, ())  # a presigned URL allows only its own file
    metadata_path = path.parent / FILE_NAME
    if not metadata_path.is_file():
        return RecordingFiles((path,), None, ())
    try:
        metadata = read_metadata(metadata_path)
    except BagError as err:
        return RecordingFiles((path,), None, (_unreadable(err),))
    names = [Path(name).name for name in metadata.files]
    if not {path.name, path.name.removesuffix(ZSTD_SUFFIX)} & set(names):
        return RecordingFiles((path,), None, ())
    if len(names) == 1:
        return RecordingFiles((path,), metadata, ())
    finding = Finding(
        "single-split",
        Severity.INFO,
        f"{path.name} is one of {len(names)} splits that {metadata_path} lists",
        help=f"name {path.parent} to read all of them",
    )
    return RecordingFiles((path,), None, (finding,))


def _discover_directory(path: AnyPath) -> RecordingFiles:
    listing = path / FILE_NAME
    findings: tuple[Finding, ...] = ()
    if listing.is_file():
        try:
            metadata = read_metadata(listing)
        except BagError as err:
            findings = (_unreadable(err),)
        else:
            return _discover_listed(metadata)
    files = _recordings(path)
    if not files:
        entries = ", ".join(sorted(entry.name for entry in _entries(path))[:5])
        raise BagError(
            f"a directory without a recording; it holds {entries or 'nothing'}",
            where=str(path),
            hint=f"name a recording ({SUFFIX_LIST}), or a directory with a metadata.yaml",
        )
    return RecordingFiles(tuple(files), None, findings)


def _discover_listed(metadata: Metadata) -> RecordingFiles:
    folder = metadata.path.parent
    files: list[AnyPath] = []
    missing: list[str] = []
    for name in metadata.files:
        file = next((file for file in _candidates(folder, name) if file.is_file()), None)
        if file is None:
            missing.append(name)
        else:
            files.append(file)
    missing_files = tuple(folder / name for name in missing) if files else ()
    unlisted = _unlisted_splits(folder, files)
    files += unlisted
    if not files:
        files = _recordings(folder)
        if not files:
            raise BagError(
                f"none of the listed files exists: {', '.join(metadata.files) or 'the list is empty'}",
                where=str(metadata.path),
                hint="restore the files next to it",
            )
    findings = tuple(
        Finding(
            "missing-split",
            Severity.WARNING,
            f"{metadata.path} lists {name}, which does not exist",
            help="restore the file; its messages are missing",
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
    return RecordingFiles(
        tuple(sorted(files, key=_natural_order) if unlisted else files), metadata, findings, missing_files
    )


def _unlisted_splits(folder: AnyPath, files: Sequence[AnyPath]) -> list[AnyPath]:
    """Return the recordings that are named like the listed splits: truncated metadata lists only the first ones."""
    names = {match.groups() for file in files if (match := _SPLIT_NAME.fullmatch(file.name))}
    return [
        file
        for file in (_recordings(folder) if names else ())
        if file not in files and (match := _SPLIT_NAME.fullmatch(file.name)) and match.groups() in names
    ]


def _recordings(folder: AnyPath) -> list[AnyPath]:
    """Return the files whose content or name is that of a recording: an empty or damaged split must not be ignored.

    Hidden files are ignored, because copying programs leave temporary ones.
    """
    files = (entry for entry in _entries(folder) if entry.is_file() and not entry.name.startswith("."))
    return sorted(
        (file for file in files if _has_recording_name(file) or is_recording(file)), key=_natural_order
    )


def _has_recording_name(file: AnyPath) -> bool:
    return file.name.removesuffix(ZSTD_SUFFIX).endswith(SUFFIXES)


def _entries(folder: AnyPath) -> list[AnyPath]:
    try:
        return list(folder.iterdir())
    except OSError as err:
        raise BagError(f"cannot be listed: {err.strerror}", where=str(folder)) from err


def _candidates(folder: AnyPath, name: str) -> Iterator[AnyPath]:
    """Yield the possible paths of a listed file: old versions include a directory, or omit the suffix of compressed files."""
    for relative in dict.fromkeys((name, Path(name).name)):
        yield folder / relative
        yield folder / f"{relative}{ZSTD_SUFFIX}"
        yield folder / relative.removesuffix(ZSTD_SUFFIX)


def _natural_order(path: AnyPath) -> list[tuple[int, str]]:
    """Return a sort key that orders `split_10` after `split_9`."""
    return [(int(token), "") if token.isdecimal() else (-1, token) for token in re.split(r"(\d+)", path.name)]


def _unreadable(err: BagError) -> Finding:
    return Finding(
        "metadata-unreadable", Severity.WARNING, str(err), help="all recordings in the folder are read"
    )
