"""This file compiles a manifest to configurations, one for each recording, field by field."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from mosaico_ingest.config import Limit, QuarantineSettings, ROSInjectionConfig, TimeBound, TimeRange
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.manifest.load import LoadedManifest
from mosaico_ingest.manifest.units import parse_instant, parse_limit, parse_offset, parse_size
from mosaico_ingest.plan.recordings import Recording, find_recordings, sequence_name
from mosaico_ingest.policies import TopicLevelErrorPolicy
from mosaico_ingest.textfile import read_whole

__all__ = ["compile_manifest", "compile_manifests"]


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
    if target.host is None:
        store = target.store
        return {"store": None if store is None else loaded.locate(store, "target", "store")}
    return {
        "host": target.host,
        "port": target.port,
        "mosaico_api_key": None if target.api_key is None else target.api_key.get_secret_value(),
        "tls_cert_path": _path(loaded, target.tls_cert),
        "enable_tls": target.tls,
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
        metadata = json.loads(read_whole(path))
    except OSError as err:
        raise ManifestError(
            f"{path} cannot be read: {(err.strerror or str(err)).lower()}", where=where
        ) from err
    except (ValueError, RecursionError) as err:
        raise ManifestError(f"{path} is not JSON: {err}", where=where) from err
    if not isinstance(metadata, dict):
        raise ManifestError(f"{path} holds no JSON object", where=where, hint='write {"key": "value"}')
    return cast("dict[str, Any]", metadata)
