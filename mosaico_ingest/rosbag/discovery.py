"""The files of a recording: find and open them, group split files, and compare them with their `metadata.yaml`."""

from __future__ import annotations

import re
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from pkgutil import resolve_name
from stat import S_ISREG
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.containers import (
    ACTIVE_SUFFIX,
    RECORDING_NAME,
    SUFFIX_LIST,
    SUFFIXES,
    ZSTD,
    ZSTD_SUFFIX,
    Container,
    container_of,
)
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import BagError
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.blocks import Connection, SplitReader, UnreadableRange
from mosaico_ingest.rosbag.compression import MAX_CHUNK_BYTES, decompress_file
from mosaico_ingest.rosbag.source import CachedSource, FileSource, RemoteSource, download

_HEAD_BYTES = 16
FILE_NAME = "metadata.yaml"
_NO_CUSTOM_DATA = re.compile(r"^ *custom_data: *(~|null|\{\}) *$", re.MULTILINE)
_TOP_KEY = "rosbag2_bagfile_information"
_MAX_BYTES = 16 << 20
_SPLIT_NAME = re.compile(
    rf"(?P<stem>.*)_\d+(?P<suffix>(?:{'|'.join(map(re.escape, SUFFIXES))})(?:{re.escape(ZSTD_SUFFIX)})?)"
)
"""The file name of a numbered split."""
NumberOf = Callable[[str], "Mapping[str, str | int | float] | None"]
"""Returns the values of a file name without its suffix, with the number of the split as `split`; None for other names."""
_NUMBERED = re.compile(r"(?P<stem>.+?)(?P<date>_\d{4}(?:-\d\d){5})?_(?P<split>\d{1,9})")
"""The name of a split: rosbag2 appends the number to the name of the recording, ROS 1 the date of the split, too."""


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


class RecordingFiles(Struct, frozen=True):
    """The files of one recording, the metadata that describes all of them, and findings about both."""

    files: tuple[AnyPath, ...]
    metadata: Metadata | None
    findings: tuple[Finding, ...]
    missing: tuple[AnyPath, ...] = ()
    """Splits that the metadata lists and that do not exist, if others do."""


class SplitGroup(Struct, frozen=True):
    """The files of one recording, in the order of their numbers."""

    files: tuple[AnyPath, ...]
    stem: str | None = None
    """The name of the recording without number and suffix; None for a file that is not a split."""


def is_recording(path: AnyPath) -> bool:
    """Return whether the file starts with the magic of a container, or of zstd."""
    head = _read_head(path)
    return head.startswith(ZSTD) or container_of(head) is not None


def open_split(path: AnyPath, stack: ExitStack, *, max_chunk_bytes: int = MAX_CHUNK_BYTES) -> SplitReader:
    """Open a file; `stack` closes it and removes temporary copies.

    Chunks whose decompressed size exceeds `max_chunk_bytes` are not read.

    Raises:
        BagError: The file is empty, not a recording, or damaged beyond reading.
        Unreachable: The server of a remote file does not respond.
    """
    if isinstance(path, RemotePath):
        return _open_remote(path, stack, max_chunk_bytes)
    head = _read_head(path)
    if head.startswith(ZSTD):
        return _open_compressed(path, path, stack, max_chunk_bytes)
    return _open_local(path, path, head, stack, max_chunk_bytes)


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


def group_splits(files: Sequence[AnyPath], number_of: NumberOf | None = None) -> tuple[SplitGroup, ...]:
    """Return the recordings that files belong to, in the order of their first files.

    Without `number_of`, files of one folder are the splits of one recording if their names differ only in the number after
    the last `_`, the numbers start at 0 and no number occurs twice. Files of ROS 1 with a date before the number belong to
    the recording that the latest number 0 started.
    """
    by_key: dict[tuple[object, ...], list[_Split]] = {}
    for file in files:
        split = _split(file, number_of)
        if split is not None:
            by_key.setdefault(split.key, []).append(split)
    groups = [
        group for splits in by_key.values() for group in _groups(splits, any_start=number_of is not None)
    ]
    group_of = {file: group for group in groups for file in group.files}
    return tuple(dict.fromkeys(group_of.get(file) or SplitGroup((file,)) for file in files))


def has_split_number(name: str) -> bool:
    """Return whether a file name ends with a number, as the names of splits do."""
    return _NUMBERED.fullmatch(_without_suffix(name)[0]) is not None


def numbering_gaps(
    files: Sequence[AnyPath], number_of: NumberOf | None = None, *, from_zero: bool = False
) -> Iterator[Finding]:
    """Yield a finding for each gap in the numbers of the splits of a recording, with `from_zero` also before the first."""
    by_key: dict[tuple[object, ...], list[_Split]] = {}
    for file in files:
        split = _split(file, number_of)
        if split is not None:
            by_key.setdefault(split.key, []).append(split)
    for splits in by_key.values() if all(_split(file, number_of) for file in files) else ():
        numbers = sorted({split.number for split in splits})
        before = [-1, *numbers] if from_zero else numbers
        for last, following in pairwise(before):
            if following > last + 1:
                missing = str(last + 1) if following == last + 2 else f"{last + 1} to {following - 1}"
                yield Finding(
                    "split-gap",
                    Severity.WARNING,
                    f"{splits[0].stem}: no file has the number {missing}",
                    help="restore the missing splits; their messages are missing",
                )


def listed_counts(files: RecordingFiles) -> dict[str, int]:
    """Return the number of messages per topic in the metadata; empty if it does not describe exactly these files."""
    metadata = files.metadata
    if metadata is None or files.missing or len(files.files) != len(metadata.files):
        return {}
    counts: Counter[str] = Counter()
    for topic in metadata.topics:
        counts[topic.topic] += topic.count
    return dict(counts)


def add_missing_messages(
    connections: Sequence[Connection],
    listed_counts: Mapping[str, int],
    unreadable: Iterable[UnreadableRange],
    *,
    file: str,
) -> tuple[tuple[Connection, ...], list[UnreadableRange]]:
    """Return the connections with the counts of the metadata, and the messages that are listed but not in the index.

    Unreadable messages of unknown topics explain differences. Topics whose counts are unknown are compared after
    reading; see `missing_after_reading`.
    """
    explained = sum(item.count or 0 for item in unreadable if item.connection is None)
    new_connections = list(connections)
    missing: list[UnreadableRange] = []
    of_topic: dict[str, list[Connection]] = defaultdict(list)
    for connection in connections:
        of_topic[connection.topic].append(connection)
    for topic, count in listed_counts.items():
        counts = [connection.count for connection in of_topic[topic]]
        difference = count - sum(number or 0 for number in counts)
        if None in counts or difference <= explained:
            explained -= max(difference, 0) if None not in counts else 0
            continue
        difference, explained = difference - explained, 0
        first = of_topic[topic][0] if of_topic[topic] else None
        if first is not None:
            new_connections[first.id] = replace(first, count=(first.count or 0) + difference)
        missing.append(_missing(topic, count, difference, first, file))
    return tuple(new_connections), missing


def missing_after_reading(
    connections: Sequence[Connection],
    listed_counts: Mapping[str, int],
    read_counts: Mapping[int, int],
    unreadable: Iterable[UnreadableRange],
    *,
    file: str,
) -> list[UnreadableRange]:
    """Return the messages that are listed but were not read, for topics without an index; `read_counts` is by connection.

    Unreadable ranges of unknown size or topic already explain any difference.
    """
    unreadable_counts: Counter[int] = Counter()
    for item in unreadable:
        if item.count is None or (item.connection is None and item.count):
            return []
        if item.connection is not None:
            unreadable_counts[item.connection] += item.count
    missing: list[UnreadableRange] = []
    for topic, count in listed_counts.items():
        matching = [connection for connection in connections if connection.topic == topic]
        if not any(connection.count is None for connection in matching):
            continue
        difference = count - sum(
            read_counts.get(each.id, 0) + unreadable_counts[each.id] for each in matching
        )
        if difference > 0 and all(each.id in read_counts for each in matching):
            missing.append(_missing(topic, count, difference, matching[0], file))
    return missing


def _open_remote(path: RemotePath, stack: ExitStack, max_chunk_bytes: int) -> SplitReader:
    """Open a remote file in place; download it if it cannot be read by range."""
    source = RemoteSource(path)
    head = source.read_some(0, _HEAD_BYTES)
    container = container_of(head)
    if container is not None and container.by_offset and source.has_ranges:
        return _opened(container, path, stack, source, max_chunk_bytes)
    logs = [log for log in _log_paths(path) if log.is_file()]
    reason = _download_reason(source, container, logs)
    if container is not None and reason is None:
        return _opened(container, path, stack, CachedSource(source))
    source.close()
    if container is None and not head.startswith(ZSTD):
        raise _not_a_recording(head, path)
    folder = _temporary_folder(stack)
    copy = download(path, folder)
    if head.startswith(ZSTD):
        split = _open_compressed(copy, path, stack, max_chunk_bytes)
        copy.unlink()
    else:
        for log in logs:
            download(log, folder)
        split = _open_local(copy, path, head, stack, max_chunk_bytes)
    split.notes.append(f"{reason}, so all {source.size} bytes were downloaded")
    return split


def _log_paths(path: RemotePath) -> list[RemotePath]:
    """Return the paths of the logs that SQLite may have left next to a file."""
    return [] if path.is_web else [path.parent / f"{path.name}{suffix}" for suffix in ("-wal", "-journal")]


def _download_reason(source: RemoteSource, container: Container | None, logs: list[RemotePath]) -> str | None:
    """Return why a file must be downloaded, None if its pages can be read by range."""
    if container is None:
        return "it is compressed"
    if not source.has_ranges:
        return "the server ignores ranges"
    if logs:
        return f"{logs[0].name} must be replayed"
    if find_spec("apsw") is None:
        return "the extra mosaico-ingest[remote] is not installed"
    return None


def _open_compressed(path: Path, name: AnyPath, stack: ExitStack, max_chunk_bytes: int) -> SplitReader:
    folder = _temporary_folder(stack)
    plain = folder / path.name.removesuffix(ZSTD_SUFFIX)
    try:
        problem = decompress_file(path, plain)
    except OSError as err:
        raise BagError(
            f"cannot be decompressed to {folder}: {err.strerror}",
            where=str(name),
            hint="decompress it yourself, or point TMPDIR at a larger disk",
        ) from err
    head = _read_head(plain)
    if problem and container_of(head) is None:
        raise BagError(
            f"{problem} after {plain.stat().st_size} decompressed bytes",
            where=str(name),
            hint="copy the file again, or check it with `zstd --test`",
        )
    split = _open_local(plain, name, head, stack, max_chunk_bytes)
    if problem:
        split.unreadable.append(UnreadableRange(plain.stat().st_size, problem))
    return split


def _open_local(
    path: Path, name: AnyPath, head: bytes, stack: ExitStack, max_chunk_bytes: int
) -> SplitReader:
    container = container_of(head)
    if container is None:
        raise _not_a_recording(head, name)
    if container.by_offset:
        return _opened(container, name, stack, FileSource(path, name), max_chunk_bytes)
    return _opened(container, name, stack, path, name)


def _opened(container: Container, name: AnyPath, stack: ExitStack, *arguments: object) -> SplitReader:
    """Create the reader of a container; see `Container.by_offset` for its arguments."""
    reader: Callable[..., SplitReader] = resolve_name(container.reader)
    try:
        split = reader(*arguments)
    except BagError as err:
        raise err if err.where else BagError(err.what, where=str(name), hint=err.hint) from err
    stack.callback(split.close)
    return split


def _temporary_folder(stack: ExitStack) -> Path:
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mosaico-")))


def _read_head(path: AnyPath) -> bytes:
    try:
        if not S_ISREG(path.stat().st_mode):  # opening a pipe would block until there is a writer
            raise BagError("a pipe, a socket or a device, not a file", where=str(path))
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as err:
        raise BagError(f"cannot be opened: {err.strerror}", where=str(path)) from err


def _not_a_recording(head: bytes, name: AnyPath) -> BagError:
    if not head:
        return BagError("the file is empty", where=str(name), hint="record again, or remove it from the job")
    return BagError(
        f"not a recording; the first bytes are {head.hex(' ')}",
        where=str(name),
        hint=f"supported are {SUFFIX_LIST} files, plain or compressed as {ZSTD_SUFFIX}",
    )


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


class _Split(Struct, frozen=True):
    file: AnyPath
    stem: str
    key: tuple[object, ...]
    number: int
    date: str = ""


def _split(file: AnyPath, number_of: NumberOf | None) -> _Split | None:
    bare, suffix = _without_suffix(file.name)
    folder, kind = str(file.parent), suffix.lower()
    if number_of is not None:
        values = number_of(file.name.removesuffix(ACTIVE_SUFFIX)) or number_of(bare)
        if values is None:
            return None
        others = tuple((key, value) for key, value in values.items() if key != "split")
        stem = "_".join(str(value) for _, value in others)
        return _Split(file, stem or file.parent.name, (folder, kind, *others), int(values["split"]))
    match = _NUMBERED.fullmatch(bare)
    if match is None:
        return None
    key = (folder, kind, match["stem"], match["date"] is None)
    return _Split(file, match["stem"], key, int(match["split"]), match["date"] or "")


def _without_suffix(name: str) -> tuple[str, str]:
    """Return a file name without its suffix, and the suffix."""
    name = name.removesuffix(ACTIVE_SUFFIX)
    suffix = RECORDING_NAME.search(name)
    return (name, "") if suffix is None else (name[: suffix.start()], suffix[0])


def _groups(splits: Sequence[_Split], *, any_start: bool) -> Iterator[SplitGroup]:
    """Yield the recordings of splits that have the same name apart from their numbers and dates."""
    recordings: list[list[_Split]] = []
    for split in sorted(splits, key=lambda split: (split.date, split.number)):
        if not recordings or (split.date and split.number <= recordings[-1][-1].number):
            recordings.append([])
        recordings[-1].append(split)
    for recording in recordings:
        numbers = [split.number for split in recording]
        is_numbered = len(set(numbers)) == len(numbers) and (any_start or numbers[0] == 0)
        if is_numbered and (any_start or len(numbers) > 1):
            name = recording[0].stem + recording[0].date
            yield SplitGroup(tuple(split.file for split in recording), name)


def _missing(
    topic: str, count: int, difference: int, connection: Connection | None, file: str
) -> UnreadableRange:
    reason = (
        f"the metadata lists {count} messages of {topic}, and {difference} of them are not in the recording"
    )
    return UnreadableRange(
        0, reason, connection=None if connection is None else connection.id, count=difference, file=file
    )
