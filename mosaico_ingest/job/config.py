"""`ROSInjectionConfig`, the constructor of a job with the signature of the official bridge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.fields import AdapterReference
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.values import (
    DEFAULT_PORT,
    IfExists,
    SessionLevelErrorPolicy,
    Stores,
    TopicLevelErrorPolicy,
)
from mosaico_ingest.remote import AnyPath, RemotePath, as_path

_KEY = "key"
_TOPIC = "*"
_TAGS = ("one", "several", "axes", "combinations")
"""The tags of unions in locations of errors."""


def _key(path: str) -> dict[str, tuple[str, ...]]:
    """Return the field metadata for a manifest key; `*` stands for each topic name or glob."""
    return {_KEY: tuple(path.split("."))}


@dataclass(frozen=True, slots=True)
class ROSInjectionConfig:
    """The configuration for ingesting one recording; `job` is the form that the pipeline uses.

    The arguments are those of the official bridge, with `store` and `manifest` in addition. Without `store` and `host`, the
    destination is the embedded store `./mosaico`. None stands for the default of any argument.

    Raises:
        ManifestError: A value is invalid, two values contradict each other, or the platform refuses a name or the metadata.
    """

    file_path: AnyPath | str | Sequence[AnyPath | str]
    """A file, a rosbag2 directory or a URL; a list names the splits of one recording."""
    sequence_name: str = field(metadata=_key("sequence.name"))
    metadata: Mapping[str, Any] | None = field(default=None, metadata=_key("sequence.metadata"))
    host: str | None = field(default=None, metadata=_key("target.host"))
    port: int = field(default=DEFAULT_PORT, metadata=_key("target.port"))
    ros_distro: Stores | str | None = field(default=None, metadata=_key("bag.ros_distro"))
    """The distro for recordings that do not contain their definitions."""
    on_error: SessionLevelErrorPolicy | str = field(
        default=SessionLevelErrorPolicy.Report, metadata=_key("on_error.session")
    )
    topics_on_error: TopicLevelErrorPolicy | str | Mapping[str, TopicLevelErrorPolicy | str] = field(
        default=TopicLevelErrorPolicy.Raise, metadata=_key("on_error.topic")
    )
    """One policy, or one for each topic name or glob, with `default` for the others."""
    custom_msgs: Sequence[tuple[str, Path | str, Stores | str | None]] | None = field(
        default=None, metadata=_key("bag.custom_msgs")
    )
    """Package, directory of `.msg` files or one file, and distro (None means every distro)."""
    topics: Sequence[str] | str | None = field(default=None, metadata=_key("topics"))
    """Topic names and globs; a leading `!` excludes. Defaults to every topic."""
    adapter_override: Mapping[str, AdapterReference] | None = field(
        default=None, metadata=_key("adapters.override")
    )
    """The adapter for a topic name or glob."""
    adapter_overrides: Mapping[str, AdapterReference] | None = None
    """Another spelling of `adapter_override`."""
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"] = field(
        default="INFO", metadata=_key("run.log_level")
    )
    mosaico_api_key: str | None = field(default=None, repr=False, metadata=_key("target.api_key"))
    tls_cert_path: Path | str | None = field(default=None, metadata=_key("target.tls_cert"))
    enable_tls: bool = field(default=False, metadata=_key("target.tls"))
    topic_metadata: Mapping[str, Mapping[str, Any]] | None = field(
        default=None, metadata=_key("topic_settings.*.metadata")
    )
    """Metadata by topic name or glob."""
    update_if_exists: bool = False
    """True is equivalent to `if_exists: append` in a manifest."""
    serialization_formats: Mapping[str, str] | None = field(
        default=None, metadata=_key("adapters.serialization_formats")
    )
    """Serialization format by message type, for types without an adapter."""
    dry_run: bool = False
    """True if `RosbagInjector.run` only plans and writes nothing."""
    registry: Any = None
    """The `ROSTypeRegistry` for definitions; defaults to the process-wide one."""
    store: AnyPath | str | None = field(default=None, metadata=_key("target.store"))
    """The directory of the embedded store, or a URL such as `s3://bucket/prefix`."""
    manifest: Mapping[str, Any] | None = None
    """Further settings, with the keys of a manifest: `{"sequence": {"if_exists": "skip"}, "run": {"jobs": 4}}`."""
    job: Job = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Build the job."""
        paths = self.file_path
        one = isinstance(paths, Path | str | RemotePath)
        splits = (as_path(paths),) if one else tuple(map(as_path, paths))
        if not splits:
            raise ManifestError("file_path is empty", hint="name a recording")
        document = self._document(str(splits[0]) if one else tuple(map(str, splits)))
        try:
            job = Job.model_validate({**document, "paths": splits, "registry": self.registry})
        except ValidationError as error:
            raise self._refusal(error.errors(include_url=False)[0]) from error
        object.__setattr__(self, "job", job.check())  # frozen after its construction

    def _document(self, path: str | tuple[str, ...]) -> dict[str, Any]:
        """Return the arguments in the structure of a manifest; `path` is that of the recording."""
        document: dict[str, Any] = {"bag": {"path": path}}
        for argument in fields(self):
            key_path, value = argument.metadata.get(_KEY), getattr(self, argument.name, None)
            if key_path is None or value is None or value == argument.default:
                continue
            if _TOPIC in key_path:
                if not isinstance(value, Mapping):
                    raise ManifestError(f"{argument.name} is {value!r:.80}", hint="give a mapping")
                for topic, setting in value.items():
                    _put(document, tuple(topic if part == _TOPIC else part for part in key_path), setting)
            else:
                _put(document, key_path, self._plain(argument.name, value))
        if self.adapter_overrides:
            _put(document, ("adapters", "override"), self._overrides())
        if self.update_if_exists:
            _put(document, ("sequence", "if_exists"), IfExists.APPEND.value)
        if self.manifest is not None:
            _merge(document, self.manifest)
        return document

    def _plain(self, name: str, value: Any) -> Any:  # noqa: ANN401 - any argument
        """Convert an argument's value to the form that the model accepts."""
        if name == "custom_msgs":
            return tuple(map(_custom_messages, value))
        if name == "topics" and isinstance(value, str):
            return (value,)
        return _plain(value)

    def _overrides(self) -> dict[str, AdapterReference]:
        overrides = {**(self.adapter_override or {})}
        for topic, adapter in (self.adapter_overrides or {}).items():
            if overrides.setdefault(topic, adapter) is not adapter:
                raise ManifestError(
                    f"adapter_override and adapter_overrides differ for {topic!r}", hint="keep one of the two"
                )
        return overrides

    def _refusal(self, error: ErrorDetails) -> ManifestError:
        """Return an error that names the argument that the model refuses."""
        location, context = error["loc"], error.get("ctx", {})
        allowed = context.get("expected")
        hint = f"allowed: {allowed}" if allowed else error["msg"].removeprefix("Value error, ")
        for argument in fields(self):
            path = argument.metadata.get(_KEY, ())
            if (
                path
                and len(location) >= len(path)
                and all(part in (_TOPIC, key) for part, key in zip(path, location, strict=False))
            ):
                topic = next((key for part, key in zip(path, location, strict=False) if part == _TOPIC), None)
                inner = [
                    key
                    for key in (topic, *location[len(path) :])
                    if key in _keys_of(getattr(self, argument.name))
                ]
                name = argument.name + "".join(f"[{key!r}]" for key in inner)
                return ManifestError(f"{name} is {error['input']!r:.80}", hint=hint)
        name = "manifest" + "".join(f"[{key!r}]" for key in location if key not in _TAGS)
        return ManifestError(f"{name} is {error['input']!r:.80}", hint=hint)


def _put(document: dict[str, Any], path: tuple[str, ...], value: object) -> None:
    for part in path[:-1]:
        document = document.setdefault(part, {})
    document[path[-1]] = value


def _merge(document: dict[str, Any], settings: Mapping[str, Any], path: tuple[str, ...] = ()) -> None:
    """Add settings to a document.

    Raises:
        ManifestError: The document has another value for one of the settings.
    """
    for key, setting in settings.items():
        value = _plain(setting)
        if isinstance(value, Mapping) and isinstance(document.get(key), dict):
            _merge(document[key], value, (*path, key))
        elif document.setdefault(key, value) != value:
            name = ".".join((*path, key))
            raise ManifestError(
                f"an argument sets {name} to {document[key]!r:.80}, and `manifest` to {value!r:.80}",
                hint="keep one of the two",
            )


def _plain(value: Any) -> Any:  # noqa: ANN401 - any argument
    """Return a value as a manifest has it; members of enumerations by value, because the SDK and rosbags have their own."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, RemotePath):
        return value.url
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return value


def _custom_messages(entry: tuple[str, Path | str, Stores | str | None]) -> dict[str, Any]:
    if len(entry) != 3:  # noqa: PLR2004 - as the hint says
        raise ManifestError(f"custom_msgs has {entry!r}", hint="give package, path, and a distro or None")
    package, path, store = entry
    return {"package": package, "path": str(path), "store": _plain(store)}


def _keys_of(value: object) -> tuple[object, ...]:
    return tuple(value) if isinstance(value, Mapping) else ()
