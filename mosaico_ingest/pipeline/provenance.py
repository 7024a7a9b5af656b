"""Provenance: the record of which files and decisions a sequence was made from."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from msgspec import Struct
from pydantic import BaseModel, ConfigDict, ValidationError
from xxhash import xxh3_128

from mosaico_ingest.destinations.base import ExistingSequence, destination_of
from mosaico_ingest.errors import BagError, SequenceExists
from mosaico_ingest.findings import escape_undecodable
from mosaico_ingest.job.split import SPLIT_KEY
from mosaico_ingest.job.values import PROVENANCE_KEY, IfExists, Target
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.quarantine import quarantine_file_name
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.version import __version__

_READ_BYTES = 1 << 20
_SAMPLES = 64
"""Number of blocks of `_READ_BYTES` that `content_digest` reads from a long file."""
_BLOCK_BYTES = 64 << 20
"""Bytes per block of `full_digest`; blocks are read in parallel."""
_HINT = "set sequence.if_exists (or --if-exists of `ingest bag`) to replace or append, or choose another name"


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
        return len(self.sources) == len(other.sources) and all(one.same_content(two) for one, two in pairs)


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
    """Return whether the stored sequence is what ended runs of the same job left incomplete of the same content."""
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
        if any(one.content == source.content and one.whole for one in stored_sources)
        and all(
            (one.content, one.modified_ns) != (source.content, source.modified_ns) for one in stored_sources
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
    """Delete what an earlier attempt of this run committed; return how to open the sequence afterwards.

    A server knows only the provenance of a sequence's first session, so sessions that were appended to another run's
    sequence are not recognized there.
    """
    destination = destination_of(plan.destination)
    existing = destination.find(plan.sequence.name)
    if existing is None:
        return plan.sequence.if_exists
    own = [s.id for s in existing.sessions if any(record.run == run for record in _records([s.metadata]))]
    if own and (
        len(own) == len(existing.sessions) or not destination.delete_sessions(plan.sequence.name, own)
    ):
        return IfExists.REPLACE
    return plan.sequence.if_exists


def _records(metadata: Iterable[Mapping[str, Any]]) -> tuple[Provenance, ...]:
    records: list[Provenance] = []
    for one in metadata:
        if PROVENANCE_KEY in one:
            try:
                records.append(Provenance.model_validate(one[PROVENANCE_KEY]))
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
