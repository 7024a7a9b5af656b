"""Provenance: the record of which files and decisions a sequence was made from."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, ValidationError
from xxhash import xxh3_128

from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.errors import BagError, SequenceExists
from mosaico_ingest.findings import encodable
from mosaico_ingest.job.values import PROVENANCE_KEY, IfExists, Target
from mosaico_ingest.pipeline.plan import Plan, decisions
from mosaico_ingest.pipeline.quarantine import kept_name
from mosaico_ingest.remote import AnyPath, RemotePath
from mosaico_ingest.version import __version__

__all__ = [
    "Held",
    "Provenance",
    "Source",
    "certain",
    "content_digest",
    "enter",
    "held",
    "provenance_of",
    "what_to_do",
    "whole_digest",
]

_READ_BYTES = 1 << 20
_SAMPLES = 64
_PIECE_BYTES = 64 << 20


def content_digest(path: Path) -> str:
    """Return a name for the content of a file: XXH3 (128 bits) over its length and all of it, or 64 MiB of it.

    Of a longer file these are pieces of a MiB, evenly from its first byte to its last, so that many long recordings are
    looked at without reading them. A new recording differs in each of them; it is no defence against forgery.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path)
    if size <= _SAMPLES * _READ_BYTES:
        return _digest(path, size, [(0, size)])
    step = (size - _READ_BYTES) / (_SAMPLES - 1)
    return _digest(path, size, [(int(number * step), _READ_BYTES) for number in range(_SAMPLES)])


def whole_digest(path: Path) -> str | None:
    """Return a name for every byte of a file, None where `content_digest` is one; pieces are read side by side.

    Raises:
        BagError: The file cannot be read.
    """
    size = _size(path)
    if size <= _SAMPLES * _READ_BYTES:
        return None
    pieces = [(start, min(_PIECE_BYTES, size - start)) for start in range(0, size, _PIECE_BYTES)]
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="digest") as pool:
        digests = pool.map(partial(_digest, path, size), ([piece] for piece in pieces))
        return xxh3_128("".join(digests).encode()).hexdigest()


def _digest(path: Path, size: int, pieces: Iterable[tuple[int, int]]) -> str:
    """Digest the length of a file and the stretches of it that begin and are as long as `pieces` says."""
    digest = xxh3_128(size.to_bytes(8, "little"))
    room = memoryview(bytearray(_READ_BYTES))
    try:
        with path.open("rb", buffering=0) as file:
            for start, left in pieces:
                file.seek(start)
                while left and (got := file.readinto(room[: min(left, _READ_BYTES)])):
                    digest.update(room[:got])
                    left -= got  # noqa: PLW2901 - what is left of this piece
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


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, defer_build=True)


class Source(_Part):
    """One file of the recording: what it is called, and what is in it."""

    name: str
    size_bytes: int
    content: str
    """Digest of its samples, see `content_digest`; behind a URL the version that is there."""
    modified_ns: int | None = None
    whole: str | None = None
    """Digest of every byte, where `content` is not one and all of it was read."""

    def same_content(self, other: Source) -> bool:
        """Say whether both are about the same bytes, as far as is known."""
        return self.content == other.content and (
            None in {self.whole, other.whole} or self.whole == other.whole
        )


class Provenance(_Part):
    """What a session was made from."""

    tool: str
    job: str
    """Digest of every decision about what is stored: topics, adapters, definitions, columns, metadata, time."""
    sources: tuple[Source, ...]
    family: str | None = None
    """What it shares its definitions with."""
    run: str | None = None
    """Which run made it, where that may begin a recording anew."""
    quarantine: str | None = None
    """The name of the file that has its rejected messages, if there are any."""

    def same_content(self, other: Provenance) -> bool:
        """Say whether both are about the same bytes, whatever the files are called."""
        pairs = zip(self.sources, other.sources, strict=False)
        return len(self.sources) == len(other.sources) and all(one.same_content(two) for one, two in pairs)


class Held(_Part):
    """What a destination has under a sequence's name."""

    provenances: tuple[Provenance, ...]
    complete: bool
    """False where an error that ended a run is attached to it, or a server has no session of it that was finished."""
    has_all_sessions: bool = True
    """False if `provenances` holds that of the first session only."""


def enter(plan: Plan) -> Plan | None:
    """Return the plan with its provenance among its metadata; None where the same content is there and is to be skipped.

    What an earlier attempt of the same run committed before its process died is no obstacle: it is made anew.

    Raises:
        SequenceExists: The plan skips the same content, and other content is there.
    """
    provenance = provenance_of(plan)
    if_exists: IfExists | None = plan.if_exists
    if plan.attempt is not None and plan.attempt.number > 1:
        if_exists = _take_back(plan, plan.attempt.run)
    if if_exists is IfExists.SKIP:
        found = held(plan.target, plan.sequence)
        provenance = certain(provenance, plan.files, found)
        if_exists = what_to_do(provenance, found, plan.sequence)
    if if_exists is None:
        return None
    provenance = _whole(provenance, plan.files)
    kept_as = kept_name(plan.sequence) if plan.quarantine else None
    noted = provenance.model_copy(update={"quarantine": kept_as}).model_dump(mode="json")
    return replace(
        plan, if_exists=if_exists, kept_as=kept_as, metadata={**plan.metadata, PROVENANCE_KEY: noted}
    )


def provenance_of(plan: Plan) -> Provenance:
    """Read the recording's files and return what this run is going to note."""
    sources = tuple(map(_source, plan.files))
    run = plan.attempt.run if plan.attempt else None
    return Provenance(tool=__version__, job=_job_digest(plan), sources=sources, family=plan.family, run=run)


def _source(path: AnyPath) -> Source:
    """Name the content of one file; behind a URL its version does, as reading all of it has its price."""
    stat = path.stat()
    name, size_bytes = encodable(path.name), stat.st_size
    if isinstance(path, RemotePath):
        return Source(name=name, size_bytes=size_bytes, content=path.version())
    return Source(
        name=name, size_bytes=size_bytes, content=content_digest(path), modified_ns=stat.st_mtime_ns
    )


def certain(provenance: Provenance, files: Sequence[AnyPath], found: Held | None) -> Provenance:
    """Return the provenance with digests of whole files where samples leave a doubt.

    They do where a file has the samples of one that is known, and was changed, or only copied, at another time.
    """
    known = [source for each in (found.provenances if found else ()) for source in each.sources]
    doubtful = {
        source.content
        for source in provenance.sources
        if any(one.content == source.content and one.whole for one in known)
        and all((one.content, one.modified_ns) != (source.content, source.modified_ns) for one in known)
    }
    return _whole(provenance, files, contents=doubtful) if doubtful else provenance


def _whole(
    provenance: Provenance, files: Sequence[AnyPath], *, contents: Container[str] | None = None
) -> Provenance:
    """Return the provenance with digests of whole files, of those with these `contents` or of all."""

    def whole(source: Source, path: AnyPath) -> Source:
        wanted = source.whole is None and (contents is None or source.content in contents)
        if isinstance(path, RemotePath):
            return source
        return source.model_copy(update={"whole": whole_digest(path)}) if wanted else source

    return provenance.model_copy(update={"sources": tuple(map(whole, provenance.sources, files))})


def held(target: Target, sequence: str) -> Held | None:
    """Return the provenance of a stored sequence, or None if the destination has no sequence of this name."""
    existing = destination_of(target).find(sequence)
    if existing is None:
        return None
    return Held(
        provenances=_provenances(session.metadata for session in existing.sessions),
        complete=existing.complete,
        has_all_sessions=existing.has_all_sessions,
    )


def what_to_do(provenance: Provenance, found: Held | None, sequence: str) -> IfExists | None:
    """Return how to open a sequence that is to be skipped where it is the same; None: it is, so do nothing.

    Raises:
        SequenceExists: What is there was made from something else.
    """
    if found is None:
        return IfExists.FAIL
    same = [known for known in found.provenances if known.same_content(provenance)]
    if not same:
        names = ", ".join(source.name for known in found.provenances for source in known.sources)
        made = f"it was made from other content ({names})" if names else "nothing says what it was made from"
        raise SequenceExists(f"the sequence exists, and {made}", where=sequence, hint=_HINT)
    if not found.complete:
        return IfExists.REPLACE
    if all(known.job != provenance.job for known in same):
        raise SequenceExists(
            "the sequence exists, and was made from this recording by another job", where=sequence, hint=_HINT
        )
    return None


def _take_back(plan: Plan, run: str) -> IfExists:
    """Delete what an earlier attempt of this run committed; return how to open the sequence afterwards.

    A server knows only the provenance of a sequence's first session, so sessions that were appended to another run's
    sequence are not recognised there.
    """
    destination = destination_of(plan.target)
    existing = destination.find(plan.sequence)
    if existing is None:
        return plan.if_exists
    own = [s.id for s in existing.sessions if any(one.run == run for one in _provenances([s.metadata]))]
    if own and (len(own) == len(existing.sessions) or not destination.delete_sessions(plan.sequence, own)):
        return IfExists.REPLACE
    return plan.if_exists


_HINT = "set sequence.if_exists (or --if-exists of `ingest bag`) to replace or append, or choose another name"


def _provenances(metadata: Iterable[Mapping[str, Any]]) -> tuple[Provenance, ...]:
    found: list[Provenance] = []
    for one in metadata:
        if PROVENANCE_KEY in one:
            try:
                found.append(Provenance.model_validate(one[PROVENANCE_KEY]))
            except ValidationError:
                continue  # written by somebody else, or by a version to come: it says nothing we know
    return tuple(found)


def _job_digest(plan: Plan) -> str:
    """Digest the decisions without where things lie, where they go and what happens when the name is taken."""
    decided = decisions(plan, folder=Path())
    aside: dict[str, Any] = {"files": True, "destination": True, "if_exists": True, "quarantine": {"path"}}
    noted = decided.model_dump(mode="json", exclude=aside)
    noted["metadata"] = dict(plan.metadata)
    return hashlib.sha256(json.dumps(noted, sort_keys=True).encode()).hexdigest()[:32]
