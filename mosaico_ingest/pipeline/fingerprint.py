"""The fingerprint of a recording and its job, by which a stored recording is recognized without opening it."""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from os.path import abspath
from pathlib import Path
from typing import Any

from pydantic_core import to_json
from xxhash import xxh3_128

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.bridge import adapter_spec, installed_adapters
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of, registered_adapters
from mosaico_ingest.errors import IngestError
from mosaico_ingest.job.fields import reference_of
from mosaico_ingest.job.model import Job, JobSettings
from mosaico_ingest.lazy import cache_by_identity
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, definition_files
from mosaico_ingest.rosbag.discovery import FILE_NAME
from mosaico_ingest.version import __version__

_SETTLED_NS, _SETTLED_SECONDS_NS = 50_000_000, 2_500_000_000
"""Minimum age of a change. A later change within one tick of the file system's clock has the same time stamp; the second
number is for file systems that store full seconds."""
_EXTERNAL_REFERENCE = re.compile(rb"\$(?:dynamic)?[rR]ef\b[\"']?\s*:\s*[\"']?(?!#|[\"']#)")
_SEPARATE = frozenset({"bag", "sequence", "quarantine", "target", "run"})
"""Sections with keys that do not affect the stored rows; of all other sections, every key counts."""

State = tuple[str, ...]
"""The name of a file and the properties that change with its content."""


def fingerprint(job: Job) -> str | None:
    """Return a digest of the state of the recording's files and of everything else that determines the stored rows.

    The state of a local file consists of path, size, inode, and the times of the last change of the content and of the
    inode; the state of a remote file consists of URL and object version. If two fingerprints are equal, reading the
    recordings leads to the same content and the same decisions. The reverse does not hold.

    None if the result depends on other sources (earlier sequences, other recordings of the run, types that only Python
    knows), if a file cannot be read, or if it has changed so recently that its next change may leave the same time.
    """
    if (
        job.registry is not None
        or job.on_schema_change is not None
        or (job.expect is not None and job.expect.group is not None)
    ):
        return None
    try:
        states = sorted(set(_recording_states(job)))
        parts = (*_job_parts(job), *("\0".join(state).encode("utf-8", "surrogateescape") for state in states))
    except (IngestError, OSError, ValueError, TypeError):  # opening the recording reports the error
        return None
    if _changed_recently(states):
        return None
    return _digest(parts)


def is_fingerprinted(job: Job, files: Iterable[AnyPath]) -> bool:
    """Return whether the fingerprint of a job covers these files of its recording: splits may be in other folders."""
    folders = {path if path.is_dir() else path.parent for path in job.paths if _is_folder(path)}
    return all(file in job.paths or file.parent in folders for file in files)


def _digest(parts: Iterable[bytes]) -> str:
    digest = xxh3_128()
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _is_folder(path: AnyPath) -> bool:
    return path.name == FILE_NAME or path.is_dir()


def _recording_states(job: Job) -> Iterator[State]:
    """Yield the states of all files that opening the recording consults."""
    for path in job.paths:
        if isinstance(path, RemotePath):
            yield from _remote_states(path)
            continue
        properties = path.stat()
        if stat.S_ISDIR(properties.st_mode) or path.name == FILE_NAME:
            folder = path if stat.S_ISDIR(properties.st_mode) else path.parent
            with os.scandir(folder) as entries:
                for entry in entries:
                    yield _state(Path(entry.path), os.stat(entry.path))  # noqa: PTH116 - half the time of a Path
        else:
            yield _state(path, properties)
            yield _state_or_absence(path.with_name(FILE_NAME))
    sidecar = job.sidecar
    if isinstance(sidecar, RemotePath):
        yield (str(sidecar), sidecar.now().version() if sidecar.now().exists() else "")
    elif sidecar is not None:
        yield _state_or_absence(sidecar)


def _remote_states(path: RemotePath) -> Iterator[State]:
    folder = path.parent if path.name == FILE_NAME else path if path.is_dir() else None
    if folder is not None:
        files: Sequence[RemotePath] = [entry for entry in folder.iterdir() if entry.is_file()]
    else:
        files = [path, path.parent / FILE_NAME]
    for file in files:
        yield (str(file), file.version() if file.exists() else "")


def _state(path: Path, properties: os.stat_result) -> State:
    numbers = (properties.st_size, properties.st_mtime_ns, properties.st_ctime_ns, properties.st_ino)
    return (abspath(path), *map(str, numbers))  # noqa: PTH100 - a link and its target are two paths


def _state_or_absence(path: Path) -> State:
    try:
        return _state(path, path.stat())
    except FileNotFoundError:
        return (abspath(path),)  # noqa: PTH100 - a link and its target are two paths


def _changed_recently(states: Sequence[State]) -> bool:
    times = [int(number) for state in states for number in state[2:4] if len(state) > 3]  # noqa: PLR2004 - local files
    newest_ns = max(times, default=0)
    has_full_seconds = all(number % 1_000_000_000 == 0 for number in times)
    return time.time_ns() - newest_ns < (_SETTLED_SECONDS_NS if has_full_seconds else _SETTLED_NS)


def _job_parts(job: Job) -> Iterator[bytes]:
    """Yield everything but the recording that the stored rows depend on."""
    yield __version__.encode()
    yield _bag_text(job.bag)
    for name in JobSettings.model_fields:
        if name not in _SEPARATE:
            yield _text(getattr(job, name))
    yield to_json(job.sequence.model_dump(mode="json", exclude={"if_exists"}))
    quarantine = job.quarantine
    yield b"" if quarantine is None else to_json(quarantine.model_dump(mode="json", exclude={"path"}))
    yield b"" if job.lock is None else job.lock.text.encode()
    yield repr(job.part).encode()
    for messages in job.bag.custom_msgs:
        for file in definition_files(Path(messages.path)):
            yield from (file.name.encode(), _content(file))
    for scope, entries in ROSTypeRegistry.snapshot().items():
        yield to_json([scope and scope.value, {name: entry.text for name, entry in entries.items()}])
    yield from _adapter_parts(job)
    schemas = {settings.metadata_schema for settings in job.topic_settings.values()}
    for schema in sorted({job.sequence.metadata_schema, *schemas} - {None}, key=str):
        content = Path(str(schema)).read_bytes()
        if _EXTERNAL_REFERENCE.search(content):
            raise ValueError("a schema refers to other files")
        yield content


def _adapter_parts(job: Job) -> Iterator[bytes]:
    """Yield the adapters outside of the manifest: files with their neighbors, classes, registered and installed ones."""
    for reference in map(reference_of, (*job.adapters.load, *job.adapters.override.values())):
        if not isinstance(reference, str):
            raise TypeError("an adapter is an object")
        if reference.endswith((".yaml", ".yml")):  # a mapping may use other mappings in its folder
            folder = (job.folder / reference).parent
            for file in sorted(path for path in folder.iterdir() if path.suffix in {".yaml", ".yml"}):
                yield from (file.name.encode(), _content(file))
        elif ":" in reference:
            yield _spec_text(adapter_spec(reference, job.folder))
    for msgtype, adapter in registered_adapters().items():
        yield from (msgtype.encode(), _class_text(adapter))
    for origin, spec in installed_adapters():
        yield from (origin.encode(), _spec_text(spec))


def _spec_text(spec: AdapterSpec) -> bytes:
    if isinstance(spec, PythonAdapterSpec):
        return _class_text(spec.adapter)
    if isinstance(spec, MappingSpec):
        return _text(spec.model)
    raise TypeError("an adapter is an object")


@cache_by_identity
def _class_text(adapter: type[Any]) -> bytes:
    model = getattr(adapter, "__mosaico_ontology_type__", None)
    if not isinstance(model, type):
        raise TypeError("the class names no ontology type")
    ontology = ontology_of(model)
    names = [adapter.__module__, adapter.__qualname__, *PythonAdapterSpec(adapter).ros_types]
    return to_json([names, ontology.tag, ontology.fingerprint, ontology.serialization_format.value])


@cache_by_identity
def _text(section: object) -> bytes:
    """Return a section as JSON; all jobs of a manifest share most of their sections."""
    return to_json(section)


@cache_by_identity
def _bag_text(bag: Any) -> bytes:  # noqa: ANN401 - a `BagSource`, which the decorator cannot express
    return to_json(bag.model_dump(mode="json", exclude={"path"}))


def _content(file: Path) -> bytes:
    properties = file.stat()
    return _content_at(
        file, properties.st_size, properties.st_mtime_ns, properties.st_ctime_ns, properties.st_ino
    )


@lru_cache(maxsize=4096)
def _content_at(file: Path, *_state: int) -> bytes:
    """Return the digest of a file that has not changed since the last call."""
    return xxh3_128(file.read_bytes()).digest()
