"""Compile a manifest to configurations, one per recording."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timezone
from difflib import get_close_matches
from glob import has_magic
from pathlib import Path
from typing import Any, cast

from msgspec import Struct

from mosaico_ingest.errors import ManifestError, NothingMatched
from mosaico_ingest.job.compose import PLACEHOLDERS, Placeholder, placeholders_in
from mosaico_ingest.job.config import QuarantineSettings, ROSInjectionConfig, TimeRange
from mosaico_ingest.job.manifest import LoadedManifest
from mosaico_ingest.job.units import (
    parse_instant,
    parse_limit,
    parse_offset,
    parse_size,
)
from mosaico_ingest.job.values import Limit, PluginTarget, TimeBound, TopicLevelErrorPolicy
from mosaico_ingest.remote import AnyPath, RemotePath, without_options
from mosaico_ingest.rosbag.formats import RECORDING_NAME
from mosaico_ingest.textfile import read_limited

__all__ = [
    "Recording",
    "compile_manifest",
    "compile_manifests",
    "find_recordings",
    "sequence_name",
]

_REFUSED = re.compile(r"[^A-Za-z0-9_-]+")


class Recording(Struct, frozen=True):
    """One recording: its parts, and its position (from 1) among those of the job."""

    paths: tuple[AnyPath, ...]
    index: int

    @property
    def main(self) -> AnyPath:
        """The path it is named after; a rosbag2 directory for its metadata.yaml."""
        first = self.paths[0]
        return first.parent if first.name == "metadata.yaml" else first


def find_recordings(loaded: LoadedManifest) -> tuple[Recording, ...]:
    """Return what `bag.path` names: a list is one recording, a glob one for each match.

    Raises:
        NothingMatched: A file is not there, or a glob matches no recording.
    """
    path = loaded.manifest.bag.path
    if isinstance(path, str):
        matches = _matches(loaded, path, ("bag", "path"))
        return tuple(Recording((match,), index) for index, match in enumerate(matches, 1))
    parts = [part for i, item in enumerate(path) for part in _matches(loaded, item, ("bag", "path", i))]
    return (Recording(tuple(dict.fromkeys(parts)), 1),)


def sequence_name(loaded: LoadedManifest, recording: Recording) -> str:
    """Fill in the placeholders of `sequence.name`; in what they stand for, `_` replaces what no name may have.

    Raises:
        ManifestError: There is no such placeholder.
    """
    template = loaded.manifest.sequence.name
    for placeholder in reversed(list(placeholders_in(template))):
        if not placeholder.known:
            raise ManifestError(
                f"unknown placeholder {template[placeholder.start : placeholder.end]} in sequence.name",
                where=loaded.where("sequence", "name"),
                hint=f"the placeholders are {', '.join(f'{{{name}}}' for name in PLACEHOLDERS)}, and {{index:03}}",
            )
        filled = _fill(placeholder, recording)
        template = template[: placeholder.start] + filled + template[placeholder.end :]
    return template


def _fill(placeholder: Placeholder, recording: Recording) -> str:
    main = recording.main
    if placeholder.name == "index":
        return f"{recording.index:{placeholder.width}}"
    if placeholder.name == "date":
        changed = datetime.fromtimestamp(main.stat().st_mtime, tz=timezone.utc)
        return f"{changed:%Y-%m-%d}"
    texts = {
        "stem": RECORDING_NAME.sub("", main.name),
        "name": main.name,
        "parent": main.resolve().parent.name,
    }
    return _REFUSED.sub("_", texts[placeholder.name]).strip("_")


def _matches(loaded: LoadedManifest, pattern: str, place: tuple[str | int, ...]) -> list[AnyPath]:
    """Return the file or directory `pattern` names, or the recordings it matches, sorted."""
    path = loaded.locate(pattern, *place)
    if path.exists():
        return [path]
    where = loaded.where(*place)
    if not has_magic(without_options(pattern)):
        raise NothingMatched(f"no such file or directory: {path}", where=where, hint=_nearby(path))
    found: list[AnyPath] = sorted(_glob(path))
    recordings = [match for match in found if _is_recording(match)]
    if not recordings:
        only = f"; it matches {len(found)} other files" if found else ""
        raise NothingMatched(f"no recording matches {path}{only}", where=where, hint=_nearby(path))
    return recordings


def _glob(path: AnyPath) -> Iterator[AnyPath]:
    """Yield what a pattern matches; what is hidden, as copying programs leave it, only where the pattern has such a name."""
    found: Iterator[tuple[AnyPath, str]]
    if isinstance(path, RemotePath):
        above = next(parent for parent in path.above if not has_magic(parent.key))
        pattern = path.key.removeprefix(above.key)
        found = ((match, match.key.removeprefix(above.key)) for match in above.glob(pattern))
    else:
        fixed = next(parent for parent in path.parents if not has_magic(str(parent)))
        # Beside other characters `**` is `*`, as behind URLs; Python before 3.13 refuses it there.
        parts = (
            part if part == "**" else re.sub(r"\*+", "*", part) for part in path.relative_to(fixed).parts
        )
        pattern = "/".join(parts)
        found = ((match, match.relative_to(fixed).as_posix()) for match in fixed.glob(pattern))
    yield from (match for match, below in found if _is_hidden(pattern) or not _is_hidden(below))


def _is_hidden(path: str) -> bool:
    return any(part.startswith(".") for part in path.split("/"))


def _is_recording(path: AnyPath) -> bool:
    if path.is_file():
        return RECORDING_NAME.search(path.name) is not None
    return path.is_dir() and ((path / "metadata.yaml").is_file() or _any_recording(_listed(path)))


def _listed(folder: AnyPath) -> list[AnyPath]:
    try:
        return list(folder.iterdir())
    except OSError:  # what a pattern meets on its way need not be ours to read
        return []


def _any_recording(paths: Iterable[AnyPath]) -> bool:
    return any(RECORDING_NAME.search(path.name) for path in paths)


def _nearby(path: AnyPath) -> str:
    """Say what is there instead: the part of the path that exists, and the nearest name in it."""
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        path, folder = folder, folder.parent
    names = sorted(entry.name for entry in _listed(folder))
    close = get_close_matches(path.name, names, n=1, cutoff=0.5)
    if close:
        return f"{folder} has {close[0]!r}"
    recordings = [name for name in names if RECORDING_NAME.search(name)]
    return f"{folder} has {', '.join(recordings[:5]) or 'no recording'}"


def compile_manifests(jobs: Sequence[LoadedManifest]) -> tuple[ROSInjectionConfig, ...]:
    """Return the configurations of every job of a manifest; see `compile_manifest`."""
    configs = tuple(config for job in jobs for config in compile_manifest(job))
    _refuse_duplicates(jobs[0], [config.sequence_name for config in configs])
    return configs


def compile_manifest(loaded: LoadedManifest) -> tuple[ROSInjectionConfig, ...]:
    """Return a configuration for each recording that `bag.path` names, in the order of their paths.

    Raises:
        NothingMatched: A file is not there, or a glob matches no recording.
        ManifestError: Two recordings would get the same name, the platform refuses one, or a file the manifest names
            cannot be used.
    """
    recordings = find_recordings(loaded)
    names = [sequence_name(loaded, recording) for recording in recordings]
    _refuse_duplicates(loaded, names)
    fields = _fields(loaded)
    return tuple(
        _config(loaded, recording, name, fields) for recording, name in zip(recordings, names, strict=True)
    )


def _config(
    loaded: LoadedManifest, recording: Recording, name: str, fields: dict[str, Any]
) -> ROSInjectionConfig:
    try:
        return ROSInjectionConfig(file_path=recording.paths, sequence_name=name, **fields)
    except ManifestError as err:
        if err.where is None:
            err.where = loaded.where("sequence", "name")
        raise


def _refuse_duplicates(loaded: LoadedManifest, names: list[str]) -> None:
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise ManifestError(
            f"{count} recordings would be named {name!r}",
            where=loaded.where("sequence", "name"),
            hint="put {stem}, {parent} or {index}, or a variable of the matrix, into sequence.name",
        )


def _fields(loaded: LoadedManifest) -> dict[str, Any]:
    """Return what all the recordings of the job have in common."""
    manifest = loaded.manifest
    return {
        "metadata": _metadata(loaded),
        "ros_distro": manifest.bag.ros_distro,
        "custom_msgs": _custom_msgs(loaded),
        "time_range": _time_range(loaded),
        "if_exists": manifest.sequence.if_exists,
        "topics": manifest.topics,
        "unmodeled": manifest.adapters.unmodeled,
        "adapters": manifest.adapters.load,
        "adapter_override": dict(manifest.adapters.override),
        "serialization_formats": dict(manifest.adapters.serialization_formats),
        "base_dir": loaded.path.parent,
        "on_error": manifest.on_error.session,
        "topics_on_error": _topic_policies(loaded),
        "messages_on_error": manifest.on_error.message,
        "family": manifest.sequence.family or manifest.sequence.name,
        "on_schema_change": manifest.on_schema_change,
        "quarantine": _quarantine(loaded),
        "log_level": manifest.run.log_level,
        "report_path": _path(loaded, manifest.run.report),
        "memory_bytes": None if manifest.run.memory is None else parse_size(manifest.run.memory),
        "jobs": manifest.run.jobs,
        "where": str(loaded.path),
        "places": {**loaded.source.spans, **loaded.source.key_spans},
        **_topic_settings(loaded),
        **_target(loaded),
    }


def _target(loaded: LoadedManifest) -> dict[str, Any]:
    target = loaded.manifest.target
    if target.type is not None:
        return {"plugin": PluginTarget(target.type, dict(target.options), loaded.path.parent)}
    if target.host is None:
        store = target.store
        return {"store": None if store is None else loaded.locate(store, "target", "store")}
    return {
        "host": target.host,
        "port": target.port,
        "mosaico_api_key": None if target.api_key is None else target.api_key.get_secret_value(),
        "tls_cert_path": _path(loaded, target.tls_cert),
        "enable_tls": target.tls,
        "message_bytes": parse_size(target.message_size),
    }


def _topic_settings(loaded: LoadedManifest) -> dict[str, Any]:
    settings = loaded.manifest.topic_settings
    return {
        "topic_metadata": {
            topic: setting.metadata for topic, setting in settings.items() if setting.metadata
        },
        "rename": {
            topic: setting.rename for topic, setting in settings.items() if setting.rename is not None
        },
        "every": {
            topic: setting.every for topic, setting in settings.items() if "every" in setting.model_fields_set
        },
        "images": {
            topic: setting.image for topic, setting in settings.items() if "image" in setting.model_fields_set
        },
    }


def _topic_policies(loaded: LoadedManifest) -> TopicLevelErrorPolicy | dict[str, TopicLevelErrorPolicy]:
    policies = loaded.manifest.on_error.topic
    return policies if isinstance(policies, TopicLevelErrorPolicy) else dict(policies)


def _quarantine(loaded: LoadedManifest) -> QuarantineSettings | None:
    section = loaded.manifest.quarantine
    if section is None:
        return None
    return QuarantineSettings(
        loaded.resolve(section.path), _limit(section.max), _limit(section.max_run), section.systematic
    )


def _limit(text: str | None) -> Limit | None:
    return None if text is None else Limit(*parse_limit(text))


def _time_range(loaded: LoadedManifest) -> TimeRange:
    time = loaded.manifest.bag.time
    return TimeRange() if time is None else TimeRange(_bound(time.start), _bound(time.end))


def _bound(text: str | None) -> TimeBound | None:
    if text is None:
        return None
    if text[:1] in {"+", "-"}:
        return TimeBound(parse_offset(text), relative=True)
    return TimeBound(parse_instant(text))


def _path(loaded: LoadedManifest, path: str | None) -> Path | None:
    return None if path is None else loaded.resolve(path)


def _custom_msgs(loaded: LoadedManifest) -> tuple[tuple[str, Path, object], ...]:
    found: list[tuple[str, Path, object]] = []
    for index, custom in enumerate(loaded.manifest.bag.custom_msgs):
        path = loaded.resolve(custom.path)
        if not path.exists():
            raise ManifestError(
                f"no such file or directory: {path}",
                where=loaded.where("bag", "custom_msgs", index, "path"),
                hint="name a directory of .msg files, or one .msg file",
            )
        found.append((custom.package, path, custom.store))
    return tuple(found)


def _metadata(loaded: LoadedManifest) -> dict[str, Any]:
    sequence = loaded.manifest.sequence
    if sequence.metadata_file is None:
        return dict(sequence.metadata)
    return {**_metadata_file(loaded, loaded.resolve(sequence.metadata_file)), **sequence.metadata}


def _metadata_file(loaded: LoadedManifest, path: Path) -> dict[str, Any]:
    where = loaded.where("sequence", "metadata_file")
    try:
        metadata = json.loads(read_limited(path))
    except OSError as err:
        raise ManifestError(
            f"{path} cannot be read: {(err.strerror or str(err)).lower()}", where=where
        ) from err
    except (ValueError, RecursionError) as err:
        raise ManifestError(f"{path} is not JSON: {err}", where=where) from err
    if not isinstance(metadata, dict):
        raise ManifestError(f"{path} holds no JSON object", where=where, hint='write {"key": "value"}')
    return cast("dict[str, Any]", metadata)
