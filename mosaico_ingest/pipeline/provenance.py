"""Provenance: the record of which files and decisions a sequence was made from, and the recognition of stored recordings."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import time
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from itertools import compress, islice
from os.path import abspath
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct, structs
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import to_json
from xxhash import xxh3_128

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.bridge import adapter_spec, installed_adapters
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.python import PythonAdapterSpec, ontology_of, registered_adapters
from mosaico_ingest.destinations import ExistingSequence, destination_of
from mosaico_ingest.errors import BagError, IngestError, SequenceExists
from mosaico_ingest.findings import escape_undecodable
from mosaico_ingest.job.fields import reference_of
from mosaico_ingest.job.model import Job, JobSettings
from mosaico_ingest.job.split import SPLIT_KEY
from mosaico_ingest.job.values import PROVENANCE_KEY, IfExists, Target
from mosaico_ingest.lazy import cache_by_identity
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.rejections import quarantine_file_name
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, definition_files
from mosaico_ingest.rosbag.discovery import FILE_NAME
from mosaico_ingest.version import __version__

_READ_BYTES = 1 << 20
_SAMPLES = 64
"""Number of blocks of `_READ_BYTES` that `content_digest` reads from a long file."""
_BLOCK_BYTES = 64 << 20
"""Bytes per block of `full_digest`; blocks are read in parallel."""
_HINT = "set sequence.if_exists (or --if-exists of `ingest bag`) to replace or append, or choose another name"
_SETTLED_NS, _SETTLED_SECONDS_NS = 50_000_000, 2_500_000_000
"""Minimum age of a change. A later change within one tick of the file system's clock has the same time stamp; the second
number is for file systems that store full seconds."""
_EXTERNAL_REFERENCE = re.compile(rb"\$(?:dynamic)?[rR]ef\b[\"']?\s*:\s*[\"']?(?!#|[\"']#)")
_SEPARATE = frozenset({"bag", "sequence", "quarantine", "target", "run"})
"""Sections with keys that do not affect the stored rows; of all other sections, every key counts."""
State = tuple[str, ...]
"""The name of a file and the properties that change with its content."""
_FIRST_BATCH, _MAX_BATCH = 8, 256
"""Number of recordings of the first and of later catalog queries: the first recording of a run starts early."""
_T = TypeVar("_T")


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)


class Source(_Part):
    """One file of the recording: its name and its content."""

    name: str
    size_bytes: int
    content: str
    """The `content_digest` of a local file, the object version of a remote one."""
    modified_ns: int | None = None
    whole: str | None = None
    """The `full_digest`, if `content` covers samples only and the complete file was read."""

    def same_content(self, other: Source) -> bool:
        """Return whether both describe the same bytes, as far as their digests can tell."""
        return self.content == other.content and (
            None in {self.whole, other.whole} or self.whole == other.whole
        )


class Provenance(_Part):
    """The files and the job that a session was made from; stored in the metadata of the sequence and the session."""

    tool: str
    job: str
    """Digest of every decision about the stored rows: topics, adapters, definitions, columns, metadata, time range."""
    sources: tuple[Source, ...]
    family: str | None = None
    """The family of sequences whose message definitions are compared."""
    run: str | None = None
    """The id of the run, if its executor may start a recording more than once."""
    fingerprint: str | None = None
    """The fingerprint of the recording and the job before the run; see `fingerprint`."""
    quarantine: str | None = None
    """The name of the quarantine file for rejected messages, if the job has a quarantine."""

    def same_content(self, other: Provenance) -> bool:
        """Return whether both were made from the same bytes, regardless of file names."""
        pairs = zip(self.sources, other.sources, strict=False)
        return len(self.sources) == len(other.sources) and all(
            source.same_content(source_of_other) for source, source_of_other in pairs
        )


class StoredProvenance(_Part):
    """The provenance of a stored sequence, one record per session."""

    records: tuple[Provenance, ...]
    complete: bool
    """False if a run ended with an error, or if a session was never finished."""
    finished: bool = True
    """False if a session is not finished: another run may still be writing it, or was killed."""
    has_all_sessions: bool = True
    """False if `records` holds only the record of the first session."""

    @classmethod
    def of(cls, existing: ExistingSequence) -> StoredProvenance:
        """Return the provenance of a sequence; records of other programs or newer versions are ignored."""
        return cls(
            records=_records(session.metadata for session in existing.sessions),
            complete=existing.complete,
            finished=existing.finished,
            has_all_sessions=existing.has_all_sessions,
        )


class SequenceRequest(Struct, frozen=True):
    """How to open a sequence in the sink, as `check_provenance` decided."""

    name: str
    metadata: Mapping[str, Any]
    """The metadata of the plan, with the provenance record."""
    if_exists: IfExists
    quarantine_file: str | None = None
    """The name of the quarantine file in the provenance record."""


def content_digest(path: Path, size_bytes: int | None = None) -> str:
    """Return an XXH3 digest (128 bits) of the length of a file and of its content, or of its first `size_bytes`.

    Of files longer than 64 MiB, only 64 evenly spaced samples of 1 MiB are read, so that long recordings are compared
    quickly. Different recordings differ in every sample; the digest does not protect against forgery.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path) if size_bytes is None else size_bytes
    if size <= _SAMPLES * _READ_BYTES:
        return _digest(path, size, [(0, size)])
    step = (size - _READ_BYTES) / (_SAMPLES - 1)
    return _digest(path, size, [(int(number * step), _READ_BYTES) for number in range(_SAMPLES)])


def full_digest(path: Path) -> str | None:
    """Return a digest of every byte of a file, None if `content_digest` reads every byte already.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path)
    if size <= _SAMPLES * _READ_BYTES:
        return None
    blocks = [(start, min(_BLOCK_BYTES, size - start)) for start in range(0, size, _BLOCK_BYTES)]
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="digest") as pool:
        digests = pool.map(partial(_digest, path, size), ([block] for block in blocks))
        return xxh3_128("".join(digests).encode()).hexdigest()


def check_provenance(plan: Plan, fingerprint: str | None = None) -> SequenceRequest | None:
    """Compare the recording with the stored sequence; return how to open the sequence, None to skip it.

    The `fingerprint` becomes part of the provenance record.

    A sequence that an interrupted run of the same job left incomplete is replaced, so that running the same command
    again completes it. Sessions that an earlier attempt of the same run committed before its process died are removed.

    Raises:
        SequenceExists: `if_exists` is `skip`, and the stored sequence has other content or is of another job.
    """
    provenance = read_provenance(plan)
    if_exists = plan.sequence.if_exists
    if plan.attempt is not None and plan.attempt.number > 1:
        if_exists = _remove_earlier_attempt(plan, plan.attempt.run)
    is_compared = if_exists in {IfExists.FAIL, IfExists.SKIP}
    stored = stored_provenance(plan.destination, plan.sequence.name) if is_compared else None
    provenance = add_doubtful_digests(provenance, plan.files, stored)
    if if_exists is IfExists.SKIP:
        decision = decide_skip(provenance, stored, files=plan.files, sequence=plan.sequence.name)
        if decision is None:
            return None
        if_exists = decision
    elif stored is not None and if_exists is IfExists.FAIL and is_repeatable(provenance, stored):
        if_exists = IfExists.REPLACE
    quarantine_file = quarantine_file_name(plan.sequence.name) if plan.quarantine else None
    added = {"quarantine": quarantine_file, "fingerprint": fingerprint}
    provenance = _add_full_digests(provenance, plan.files).model_copy(update=added)
    return SequenceRequest(
        name=plan.sequence.name,
        metadata={
            **plan.sequence.metadata,
            **plan.kept_metadata,
            **({} if plan.part is None else {SPLIT_KEY: plan.part.metadata}),
            PROVENANCE_KEY: provenance.model_dump(mode="json"),
        },
        if_exists=if_exists,
        quarantine_file=quarantine_file,
    )


def read_provenance(plan: Plan) -> Provenance:
    """Read the recording's files and return the provenance record of this run, without full digests."""
    return Provenance(
        tool=__version__,
        job=_job_digest(plan),
        sources=tuple(map(_source if plan.part is None else _cached_source, plan.files)),
        family=plan.sequence.family,
        run=plan.attempt.run if plan.attempt else None,
    )


def stored_provenance(target: Target, sequence: str) -> StoredProvenance | None:
    """Return the provenance of a stored sequence, None if the destination has no sequence of this name."""
    existing = destination_of(target).find(sequence)
    return None if existing is None else StoredProvenance.of(existing)


def decide_skip(
    provenance: Provenance, stored: StoredProvenance | None, *, files: Sequence[AnyPath], sequence: str
) -> IfExists | None:
    """Return how to open a sequence with `if_exists: skip`, None if the same content is stored already.

    A sequence is replaced if its run ended early, or if its source files have grown since and still begin with the content
    that was ingested, for example because an upload stalled.

    Raises:
        SequenceExists: The stored sequence was made from other content, or by another job.
    """
    if stored is None:
        return IfExists.FAIL
    same = [record for record in stored.records if record.same_content(provenance)]
    if not same and any(_has_grown(record, files) for record in stored.records):
        return IfExists.REPLACE
    if not same:
        names = ", ".join(source.name for record in stored.records for source in record.sources)
        cause = f"was made from other content ({names})" if names else "has no provenance record"
        raise SequenceExists(f"the sequence exists and {cause}", where=sequence, hint=_HINT)
    if not stored.complete:
        return IfExists.REPLACE
    if all(record.job != provenance.job for record in same):
        raise SequenceExists(
            "the sequence exists and was made from this recording by another job", where=sequence, hint=_HINT
        )
    return None


def is_repeatable(provenance: Provenance, stored: StoredProvenance) -> bool:
    """Return whether the stored sequence is incomplete, and all of its sessions come from this job and this content."""
    return (
        not stored.complete
        and stored.finished
        and bool(stored.records)
        and all(record.job == provenance.job and record.same_content(provenance) for record in stored.records)
    )


def _has_grown(record: Provenance, files: Sequence[AnyPath]) -> bool:
    """Return whether every file begins with the content of the record's source, and at least one is longer."""
    if len(files) != len(record.sources):
        return False
    sizes = [path.stat().st_size for path in files]
    return any(size > source.size_bytes for size, source in zip(sizes, record.sources, strict=True)) and all(
        isinstance(path, Path)
        and size >= source.size_bytes
        and content_digest(path, source.size_bytes) == source.content
        for path, size, source in zip(files, sizes, record.sources, strict=True)
    )


def add_doubtful_digests(
    provenance: Provenance, files: Sequence[AnyPath], stored: StoredProvenance | None
) -> Provenance:
    """Add full digests of files whose samples match a stored source with another modification time.

    Such a file was either copied or changed between the samples.
    """
    stored_sources = [source for record in (stored.records if stored else ()) for source in record.sources]
    doubtful = {
        source.content
        for source in provenance.sources
        if any(entry.content == source.content and entry.whole for entry in stored_sources)
        and all(
            (entry.content, entry.modified_ns) != (source.content, source.modified_ns)
            for entry in stored_sources
        )
    }
    return _add_full_digests(provenance, files, contents=doubtful) if doubtful else provenance


def _add_full_digests(
    provenance: Provenance, files: Sequence[AnyPath], *, contents: Container[str] | None = None
) -> Provenance:
    """Add full digests to the local sources with one of these `contents`, by default to all of them."""

    def with_digest(source: Source, path: AnyPath) -> Source:
        is_requested = source.whole is None and (contents is None or source.content in contents)
        if isinstance(path, RemotePath) or not is_requested:
            return source
        return source.model_copy(update={"whole": full_digest(path)})

    return provenance.model_copy(update={"sources": tuple(map(with_digest, provenance.sources, files))})


def _remove_earlier_attempt(plan: Plan, run: str) -> IfExists:
    """Delete the sessions that an earlier attempt of this run committed; return how to open the sequence afterwards.

    A server knows only the provenance of a sequence's first session, so sessions that were appended to another run's
    sequence are not recognized there.
    """
    destination = destination_of(plan.destination)
    existing = destination.find(plan.sequence.name)
    if existing is None:
        return plan.sequence.if_exists
    sessions = [
        s.id for s in existing.sessions if any(record.run == run for record in _records([s.metadata]))
    ]
    if sessions and (
        len(sessions) == len(existing.sessions)
        or not destination.delete_sessions(plan.sequence.name, sessions)
    ):
        return IfExists.REPLACE
    return plan.sequence.if_exists


def _records(metadata: Iterable[Mapping[str, Any]]) -> tuple[Provenance, ...]:
    records: list[Provenance] = []
    for entry in metadata:
        if PROVENANCE_KEY in entry:
            try:
                records.append(Provenance.model_validate(entry[PROVENANCE_KEY]))
            except ValidationError:
                continue
    return tuple(records)


def _cached_source(path: AnyPath) -> Source:
    """Return the source of a file with its full digest; the file is read once for all parts of a recording."""
    stat = path.stat()
    return _read_source(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=64)
def _read_source(path: AnyPath, _size: int, _modified_ns: int) -> Source:
    source = _source(path)
    return source if isinstance(path, RemotePath) else source.model_copy(update={"whole": full_digest(path)})


def _source(path: AnyPath) -> Source:
    stat = path.stat()
    name, size_bytes = escape_undecodable(path.name), stat.st_size
    if isinstance(path, RemotePath):  # its version identifies the content without a download
        return Source(name=name, size_bytes=size_bytes, content=path.version())
    return Source(
        name=name, size_bytes=size_bytes, content=content_digest(path), modified_ns=stat.st_mtime_ns
    )


def _job_digest(plan: Plan) -> str:
    """Return a digest of the decisions about the stored rows: not of paths, the destination, `if_exists` or `expect`."""
    document = plan.document(folder=Path())
    for key in ("files", "destination", "contract"):
        del document[key]
    for key in ("if_exists", "family"):
        del document["sequence"][key]
    if document["quarantine"] is not None:
        del document["quarantine"]["path"]
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()[:32]


def _digest(path: Path, size: int, ranges: Iterable[tuple[int, int]]) -> str:
    """Return a digest of the length of a file and of some of its ranges, each an offset and a length."""
    digest = xxh3_128(size.to_bytes(8, "little"))
    buffer = memoryview(bytearray(_READ_BYTES))
    try:
        with path.open("rb", buffering=0) as file:
            for offset, length in ranges:
                file.seek(offset)
                remaining = length
                while remaining and (count := file.readinto(buffer[: min(remaining, _READ_BYTES)])):
                    digest.update(buffer[:count])
                    remaining -= count
    except OSError as error:
        raise _unreadable(path, error) from error
    return digest.hexdigest()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> BagError:
    return BagError(f"cannot be read: {error.strerror}", where=str(path))


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
    return _parts_digest(parts)


def is_fingerprinted(job: Job, files: Iterable[AnyPath]) -> bool:
    """Return whether the fingerprint of a job covers these files of its recording: splits may be in other folders."""
    folders = {path if path.is_dir() else path.parent for path in job.paths if _is_folder(path)}
    return all(file in job.paths or file.parent in folders for file in files)


def _parts_digest(parts: Iterable[bytes]) -> str:
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
    """Return a section as text; all jobs of a manifest share most of their sections."""
    # JSON would need the serializer of the section's class, which takes 5 ms to build for `expect`.
    return repr(section).encode("utf-8", "surrogateescape")


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


def mark_known(
    tasks: Iterable[Task], is_finished: Callable[[str, str], bool] | None = None
) -> Iterator[Task]:
    """Yield the tasks, and mark a task as known if its recording is stored, complete and unchanged and may be skipped.

    It may be skipped with `if_exists: skip`. In a run that continues another one, `is_finished` returns whether that run
    reported a sequence and destination as stored. A recording may then also be skipped if it was, and with
    `if_exists: append`: the run may have been killed before it reported the rows, which would be stored twice.
    """

    def may_be_skipped(task: Task) -> bool:
        job = task.job
        if task.plan_digest is not None or task.dry_run:
            return False
        if job.sequence.if_exists is IfExists.SKIP or is_finished is None:
            return job.sequence.if_exists is IfExists.SKIP
        return job.sequence.if_exists is IfExists.APPEND or is_finished(
            job.sequence.name, destination_of(job.destination).describe()
        )

    for batch in _batches(tasks):
        skippable = [may_be_skipped(task) for task in batch]
        is_known = iter(known_recordings([task.job for task in compress(batch, skippable)]))
        for task, is_skippable in zip(batch, skippable, strict=True):
            yield structs.replace(task, known=True) if is_skippable and next(is_known) else task


def with_known(jobs: Iterable[Job]) -> Iterator[tuple[Job, bool]]:
    """Yield each job, and whether its recording is stored, complete and unchanged."""
    for batch in _batches(jobs):
        yield from zip(batch, known_recordings(batch), strict=True)


def known_recordings(jobs: Sequence[Job]) -> list[bool]:
    """Return for each job whether its recording is stored, complete and unchanged, according to its fingerprint.

    False means that the recording has to be opened and compared. Opening the recording raises errors; this function does not.
    """
    positions: dict[tuple[int, Path], list[int]] = defaultdict(list)
    for position, job in enumerate(jobs):
        # Targets are not hashable, and the jobs of a manifest share one.
        positions[id(job.target), job.folder].append(position)
    are_known = [False] * len(jobs)
    for group in positions.values():
        stored = _stored([jobs[position] for position in group])
        for position in group:
            existing = stored.get(jobs[position].sequence.name)
            if existing is not None and existing.complete:
                prints = {record.fingerprint for record in StoredProvenance.of(existing).records} - {None}
                are_known[position] = bool(prints) and fingerprint(jobs[position]) in prints
    return are_known


def _stored(jobs: Sequence[Job]) -> dict[str, ExistingSequence]:
    """Return the stored sequences of jobs with one destination; empty if it cannot be read."""
    try:
        return destination_of(jobs[0].destination).find_all([job.sequence.name for job in jobs])
    except Exception:  # noqa: BLE001 - destinations may be of other packages, and the run of the recording reports it
        return {}


def _batches(items: Iterable[_T]) -> Iterator[list[_T]]:
    iterator = iter(items)
    size = _FIRST_BATCH
    while batch := list(islice(iterator, size)):
        yield batch
        size = min(2 * size, _MAX_BATCH)
