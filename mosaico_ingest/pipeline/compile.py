"""Compile a manifest to jobs, one per recording."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timezone
from difflib import get_close_matches
from glob import has_magic
from pathlib import Path
from typing import Any

from msgspec import Struct

from mosaico_ingest.containers import RECORDING_NAME
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import ManifestError, NothingMatched
from mosaico_ingest.findings import Finding, Severity
from mosaico_ingest.job.fields import (
    FilePath,
    PathRole,
    marked_fields,
    replace_values,
)
from mosaico_ingest.job.manifest import PLACEHOLDERS, LoadedManifest, Placeholder, placeholders_in, refusal
from mosaico_ingest.job.model import Job, JobSettings, Manifest, Origin, SequenceSettings
from mosaico_ingest.job.validation import pattern_problems
from mosaico_ingest.job.values import LOCK_SUFFIX, FileNamePattern, LockFile
from mosaico_ingest.job.yaml_source import Source
from mosaico_ingest.lazy import LazySequence, concatenate
from mosaico_ingest.metadata import read_json, source_spans, with_spans
from mosaico_ingest.protocol import is_sequence_name
from mosaico_ingest.remote import AnyPath, RemotePath, with_network, without_options
from mosaico_ingest.rosbag.discovery import SplitGroup, group_splits, has_split_number, recording_files

_READ_LATER = {PathRole.WORKER_FILE, PathRole.DEFINITIONS, PathRole.SCHEMA}
_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")


_Match = str | RemotePath
"""A path that `bag.path` matches; local paths as text, which needs a quarter of the memory of a `Path`."""


class Recording(Struct, frozen=True):
    """One recording: its files, and its position (from 1) among the recordings of the job."""

    paths: tuple[AnyPath, ...]
    index: int
    group: str | None = None
    """The name of the recording without number and suffix, if `bag.group` found its splits."""

    @property
    def main(self) -> AnyPath:
        """The path it is named after; a rosbag2 directory for its metadata.yaml."""
        first = self.paths[0]
        return first.parent if first.name == "metadata.yaml" else first


def find_recordings(loaded: LoadedManifest) -> LazySequence[Recording]:
    """Return the recordings of `bag.path`: a list is one recording, and every match of a glob is one.

    Raises:
        NothingMatched: A file does not exist, or a glob matches no recording.
    """
    path = loaded.manifest.bag.path
    sources: Sequence[_Match | SplitGroup]
    if isinstance(path, str):
        sources = _grouped(loaded, _matches(loaded, path, ("bag", "path")))
    else:
        parts = [part for i, item in enumerate(path) for part in _matches(loaded, item, ("bag", "path", i))]
        sources = (SplitGroup(tuple(map(_path, dict.fromkeys(parts)))),)

    def recording(position: int) -> Recording:
        source = sources[position]
        group = source if isinstance(source, SplitGroup) else SplitGroup((_path(source),))
        return Recording(group.files, position + 1, group.stem)

    return LazySequence(recording, range(len(sources)), [recording(0)])


def _grouped(loaded: LoadedManifest, matches: Sequence[_Match]) -> Sequence[_Match | SplitGroup]:
    """Return the recordings that the matches of `bag.path` belong to, according to `bag.group`."""
    group = loaded.manifest.bag.group
    if isinstance(group, FileNamePattern):
        files = [file for match in matches for file in recording_files(_path(match))]
        return group_splits(files, group.match)
    if group == "none" or len(matches) == 1:
        return matches
    numbered = [match for match in matches if has_split_number(_file_name(match))]
    group_of = {
        file: group
        for group in group_splits(list(map(_path, numbered)))
        if group.stem is not None
        for file in group.files
    }
    if not group_of:
        return matches
    return list(dict.fromkeys(group_of.get(_path(match), match) for match in matches))


def _naming(loaded: LoadedManifest) -> Callable[[Recording], str]:
    """Return the function that fills in `sequence.name`; `_` replaces characters that names cannot have.

    Raises:
        ManifestError: The name has an unknown placeholder.
    """
    template = loaded.manifest.sequence.name
    placeholders = list(placeholders_in(template))
    texts: list[str] = []
    end = 0
    for placeholder in placeholders:
        if not placeholder.known:
            raise ManifestError(
                f"unknown placeholder {template[placeholder.start : placeholder.end]} in sequence.name",
                where=loaded.where("sequence", "name"),
                hint=f"the placeholders are {', '.join(f'{{{name}}}' for name in PLACEHOLDERS)}, and {{index:03}}",
            )
        texts.append(template[end : placeholder.start])
        end = placeholder.end

    def name(recording: Recording) -> str:
        filled = (
            text + _fill(placeholder, recording)
            for text, placeholder in zip(texts, placeholders, strict=True)
        )
        return "".join(filled) + template[end:]

    return name


def _fill(placeholder: Placeholder, recording: Recording) -> str:
    main = recording.main
    if placeholder.name == "index":
        return f"{recording.index:{placeholder.width}}"
    if placeholder.name == "date":
        changed = datetime.fromtimestamp(main.stat().st_mtime, tz=timezone.utc)
        return f"{changed:%Y-%m-%d}"
    if main.name in {"", ".."}:  # such as `bag.path: ..`
        main = main.resolve()
    if placeholder.name == "parent":
        text = main.resolve().parent.name  # a request to the file system, like the date
    else:
        text = (
            main.name if placeholder.name == "name" else recording.group or RECORDING_NAME.sub("", main.name)
        )
    return _REFUSED.sub("_", text).strip("_")


def _matches(
    loaded: LoadedManifest, pattern: str, key_path: tuple[str | int, ...]
) -> Sequence[str] | Sequence[RemotePath]:
    """Return the file or directory with this path, or the recordings that match it as a glob, sorted."""
    path = with_network(loaded.resolve_or_url(pattern, *key_path), loaded.manifest.network.limits)
    if path.exists():
        return [path] if isinstance(path, RemotePath) else [str(path)]
    where = loaded.where(*key_path)
    if not has_magic(without_options(pattern)):
        raise NothingMatched(f"no such file or directory: {path}", where=where, hint=_nearby(path))
    others = 0
    texts: list[str] = []
    remote: list[RemotePath] = []
    for match in _glob(path):
        if not _is_recording(match):
            others += 1
        elif isinstance(match, RemotePath):
            remote.append(match)
        else:
            texts.append(str(match))
    if not texts and not remote:
        only = f"; it matches {others} other files" if others else ""
        raise NothingMatched(f"no recording matches {path}{only}", where=where, hint=_nearby(path))
    # The order of the components of the paths: a separator is smaller than every other character.
    texts.sort(key=lambda text: text.replace(os.sep, "\0"))
    remote.sort(key=lambda path: (path.root, path.key))
    return texts or remote


def _path(match: _Match) -> AnyPath:
    return Path(match) if isinstance(match, str) else match


def _file_name(match: _Match) -> str:
    return match.rpartition(os.sep)[2] if isinstance(match, str) else match.name


def _glob(path: AnyPath) -> Iterator[AnyPath]:
    """Yield the matches of a pattern; hidden files, such as those of copying programs, only if the pattern names them."""
    matches: Iterator[tuple[AnyPath, str]]
    if isinstance(path, RemotePath):
        above = next(parent for parent in path.above if not has_magic(parent.key))
        pattern = path.key.removeprefix(above.key)
        matches = ((match, match.key.removeprefix(above.key)) for match in above.glob(pattern))
    else:
        fixed = next(parent for parent in path.parents if not has_magic(str(parent)))
        # Beside other characters `**` is `*`, as behind URLs; Python before 3.13 refuses it there.
        parts = (
            part if part == "**" else re.sub(r"\*+", "*", part) for part in path.relative_to(fixed).parts
        )
        pattern = "/".join(parts)
        depth = len(fixed.parts)
        matches = ((match, "/".join(match.parts[depth:])) for match in fixed.glob(pattern))
    names_hidden = _is_hidden(pattern)
    yield from (match for match, below in matches if names_hidden or not _is_hidden(below))


def _is_hidden(path: str) -> bool:
    return path.startswith(".") or "/." in path


def _is_recording(path: AnyPath) -> bool:
    if path.is_file():
        return RECORDING_NAME.search(path.name) is not None
    return path.is_dir() and (
        (path / "metadata.yaml").is_file()
        or any(RECORDING_NAME.search(entry.name) for entry in _listed(path))
    )


def _listed(folder: AnyPath) -> list[AnyPath]:
    try:
        return list(folder.iterdir())
    except OSError:  # a glob may cover folders without permission to read
        return []


def _nearby(path: AnyPath) -> str:
    """Return a hint with the existing part of a path and the nearest name in it."""
    if isinstance(path, RemotePath) and path.is_web:
        return "check the URL"
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        path, folder = folder, folder.parent
    names = sorted(entry.name for entry in _listed(folder))
    close = get_close_matches(path.name, names, n=1, cutoff=0.5)
    if close:
        return f"{folder} has {close[0]!r}"
    recordings = [name for name in names if RECORDING_NAME.search(name)]
    return f"{folder} has {', '.join(recordings[:5]) or 'no recording'}"


def compile_manifests(manifests: Sequence[LoadedManifest], *, locked: bool = True) -> LazySequence[Job]:
    """Return the jobs of the recordings of every combination of a manifest's matrix; see `compile_manifest`."""
    compiled = [compile_manifest(loaded, locked=locked) for loaded in manifests]
    if len(compiled) == 1:
        return compiled[0]
    jobs = concatenate(compiled)
    _refuse_duplicates(manifests[0], [job.sequence.name for job in jobs])
    return jobs


def compile_manifest(loaded: LoadedManifest, *, locked: bool = True) -> LazySequence[Job]:
    """Return a job for each recording that `bag.path` names, in the order of their paths.

    All names are checked here, but a job is only built when it is accessed. With `split`, every recording is opened and
    the jobs of all parts are kept. With `locked=False`, the lock file of `definitions: locked` is not read.

    Raises:
        NothingMatched: A file does not exist, or a glob matches no recording.
        ManifestError: Two recordings would have the same name, the platform refuses a name or metadata, or a file that
            the manifest names cannot be used.
    """
    _check_patterns(loaded)
    recordings = find_recordings(loaded)
    names = list(map(_naming(loaded), recordings))
    _refuse_duplicates(loaded, names)
    shared = _resolve_paths(loaded)
    metadata, origin = _metadata(loaded, shared.sequence)
    sequence = shared.sequence.replace(
        family=shared.sequence.family or shared.sequence.name, metadata=metadata, metadata_file=None
    )
    sections: dict[str, Any] = {key: getattr(shared, key) for key in JobSettings.model_fields}
    lock = None if shared.definitions is None or not locked else read_lock_file(loaded.path, loaded.origin)
    template = Job.model_construct(None, **{**sections, "lock": lock}, paths=(), origin=origin)

    def job(position: int) -> Job:
        name, paths = names[position], recordings[position].paths
        return template.replace(sequence=sequence.replace(name=name), paths=paths)

    for position, name in enumerate(names):
        if not is_sequence_name(name):
            job(position).check_name()
    jobs = LazySequence(job, range(len(names)), [job(0).check()])  # the jobs differ only in their names
    if loaded.manifest.split is None:
        return jobs
    from mosaico_ingest.pipeline.split import split_job  # noqa: PLC0415 - only jobs with `split` need it

    parts = [part for job in jobs for part in split_job(job)]
    _refuse_duplicates(loaded, [part.sequence.name for part in parts])
    return LazySequence(parts.__getitem__, range(len(parts)), parts[:1])


def _check_patterns(loaded: LoadedManifest) -> None:
    """Raise ManifestError if a topic pattern cannot match any topic name."""
    findings = tuple(
        Finding("topic-pattern", Severity.ERROR, problem.message, problem.span, problem.hint)
        for problem in pattern_problems(loaded.manifest, loaded.source)
    )
    if findings:
        raise refusal(findings, str(loaded.path))


def _refuse_duplicates(loaded: LoadedManifest, names: list[str]) -> None:
    if len(set(names)) == len(names):
        return
    name, count = Counter(names).most_common(1)[0]
    raise ManifestError(
        f"{count} recordings would be named {name!r}",
        where=loaded.where("sequence", "name"),
        hint="add {stem}, {parent}, {index} or a variable of the matrix to sequence.name",
    )


def _resolve_paths(loaded: LoadedManifest) -> Manifest:
    """Return the manifest with every path but those of recordings starting at the current folder."""
    manifest = loaded.manifest
    for field in marked_fields(JobSettings, FilePath):
        role = field.marker.role

        def resolve(path: tuple[str | int, ...], text: str, role: PathRole = role) -> str:
            if role is PathRole.STORE:
                resolved = loaded.resolve_or_url(text, *path)
                return text if isinstance(resolved, RemotePath) else str(resolved)
            resolved = loaded.resolve(text, *path)
            if role in _READ_LATER and not resolved.exists():
                raise ManifestError(
                    f"no such file or directory: {resolved}",
                    where=loaded.where(*path),
                    hint="correct the path; relative paths start at the manifest's folder",
                )
            return str(resolved)

        if role is not PathRole.RECORDING:
            manifest = replace_values(manifest, field.path, resolve)
    return manifest


def _metadata(loaded: LoadedManifest, sequence: SequenceSettings) -> tuple[dict[str, Any], Origin]:
    """Return the metadata of the manifest and of its metadata file, and the origin with the spans of both."""
    origin = loaded.origin
    if sequence.metadata_file is None:
        return sequence.metadata, origin
    where = loaded.where("sequence", "metadata_file")
    path = sequence.metadata_file
    try:
        metadata = json.loads(read_limited(Path(path)))
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ManifestError(f"{path} cannot be read: {reason}", where=where) from error
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"{path} is not JSON: {error}", where=where) from error
    if not isinstance(metadata, dict):
        raise ManifestError(f"{path} has no JSON object", where=where, hint='write {"key": "value"}')
    if sequence.metadata_schema is not None:
        source = read_json(Path(path))
        for key in metadata:
            if isinstance(source, Source) and key not in sequence.metadata:
                origin = with_spans(origin, *source_spans(source, key))
    return {**metadata, **sequence.metadata}, origin


def lock_path(manifest: Path) -> Path:
    """Return the path of a manifest's lock file, such as `job.lock.json` for `job.yaml`."""
    return manifest.with_suffix(LOCK_SUFFIX)


def read_lock_file(manifest: Path, origin: Origin = Origin()) -> LockFile:  # noqa: B008 - origins are immutable
    """Return the text of a manifest's lock file.

    Raises:
        ManifestError: The file cannot be read; the error has the location of `definitions`.
    """
    path = lock_path(manifest)
    try:
        return LockFile(str(path), read_limited(path).decode())
    except (OSError, UnicodeDecodeError) as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "does not exist" if missing else "cannot be read"
        message = f"the lock file {path} {reason}"
        hint = f"run `ingest schema lock {manifest}`" if missing else "restore it from version control"
        span = origin.spans.get(("definitions",))
        finding = Finding("lock-file", Severity.ERROR, message, span, hint)
        where = str(span) if span else str(manifest)
        raise ManifestError(message, where=where, hint=hint, findings=(finding,)) from error
