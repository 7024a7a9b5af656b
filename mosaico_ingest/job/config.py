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
from mosaico_ingest.job.model import AdapterReference, Job, Origin, QuarantineSettings, TimeRange
from mosaico_ingest.job.values import (
    DEFAULT_MESSAGE_BYTES,
    DEFAULT_PORT,
    IfExists,
    LoaderErrorPolicy,
    OnSchemaChange,
    PluginTarget,
    SessionLevelErrorPolicy,
    Stores,
    TopicLevelErrorPolicy,
    Unmodeled,
)
from mosaico_ingest.remote import AnyPath, RemotePath, as_path

_KEY = "key"
_TOPIC = "*"


def _key(path: str) -> dict[str, tuple[str, ...]]:
    """Return the field metadata for a manifest key; `*` stands for each topic name or glob."""
    return {_KEY: tuple(path.split("."))}


@dataclass(frozen=True, slots=True)
class ROSInjectionConfig:
    """The configuration for ingesting one recording; `job` is the form that the pipeline uses.

    Without `store` and `host`, the destination is the embedded store `./mosaico`. None stands for the default of any
    argument.

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
    """True is equivalent to `if_exists=IfExists.APPEND`."""
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
    if_exists: IfExists | str = field(default=IfExists.FAIL, metadata=_key("sequence.if_exists"))
    messages_on_error: LoaderErrorPolicy | str = field(
        default=LoaderErrorPolicy.LOG_WARN, metadata=_key("on_error.message")
    )
    adapters: Sequence[AdapterReference] | None = field(default=None, metadata=_key("adapters.load"))
    """Adapters for every topic of their types; they take precedence over the built-in ones."""
    unmodeled: Unmodeled | str = field(default=Unmodeled.KEEP, metadata=_key("adapters.unmodeled"))
    base_dir: Path = Path()
    """The folder where the relative paths of adapters start."""
    time_range: TimeRange | None = field(default=None, metadata=_key("bag.time"))
    images: Mapping[str, str] | None = field(default=None, metadata=_key("topic_settings.*.image"))
    """Encoding of raw images (raw or png) by topic name or glob."""
    rename: Mapping[str, str] | None = field(default=None, metadata=_key("topic_settings.*.rename"))
    """Name in the sequence by topic name."""
    every: Mapping[str, int] | None = field(default=None, metadata=_key("topic_settings.*.every"))
    """Keep the first of each `every` messages, by topic name or glob."""
    report_path: Path | str | None = field(default=None, metadata=_key("run.report"))
    memory_bytes: int | None = field(default=None, metadata=_key("run.memory"))
    """Maximum memory of batches, in bytes."""
    jobs: int = field(default=1, metadata=_key("run.jobs"))
    """Maximum number of recordings to ingest at the same time."""
    quarantine: QuarantineSettings | None = field(default=None, metadata=_key("quarantine"))
    """The quarantine of rejected messages; without a quarantine, they are only counted."""
    expect: Mapping[str, Any] | None = field(default=None, metadata=_key("expect"))
    """The data contract, in the structure of the section `expect` of manifests."""
    family: str | None = field(default=None, metadata=_key("sequence.family"))
    """The name that sequences with the same message definitions share; defaults to `sequence_name`."""
    on_schema_change: OnSchemaChange | str | None = field(default=None, metadata=_key("on_schema_change"))
    """Action if a topic's definition differs from that of the family; if omitted, definitions are not compared."""
    message_bytes: int = field(default=DEFAULT_MESSAGE_BYTES, metadata=_key("target.message_size"))
    """Maximum size, in bytes, up to which rows are combined into one upload message to a server."""
    metadata_from: Mapping[str, Any] | None = field(default=None, metadata=_key("sequence.metadata_from"))
    """Sources of metadata that the recording fills, with the keys of `sequence.metadata_from`."""
    metadata_schema: Path | str | None = field(default=None, metadata=_key("sequence.metadata_schema"))
    """The JSON Schema of the metadata."""
    plugin: PluginTarget | None = None
    """A destination that an installed package provides, instead of `store` and `host`."""
    job: Job = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Build the job."""
        paths = self.file_path
        one = isinstance(paths, Path | str | RemotePath)
        splits = (as_path(paths),) if one else tuple(map(as_path, paths))
        if not splits:
            raise ManifestError("file_path is empty", hint="name a recording")
        document = self._document()
        document["bag"]["path"] = str(splits[0]) if one else tuple(map(str, splits))
        try:
            job = Job.model_validate(
                {
                    **document,
                    "paths": splits,
                    "origin": Origin(folder=self.base_dir),
                    "registry": self.registry,
                }
            )
        except ValidationError as error:
            raise self._refusal(error.errors(include_url=False)[0]) from error
        object.__setattr__(self, "job", job.check())  # frozen after its construction

    def _document(self) -> dict[str, Any]:
        """Return the arguments in the structure of a manifest."""
        document: dict[str, Any] = {"bag": {}}
        for argument in fields(self):
            path, value = argument.metadata.get(_KEY), getattr(self, argument.name, None)
            if path is None or value is None or value == argument.default:
                continue
            if _TOPIC in path:
                if not isinstance(value, Mapping):
                    raise ManifestError(f"{argument.name} is {value!r:.80}", hint="give a mapping")
                for topic, setting in value.items():
                    _put(document, tuple(topic if part == _TOPIC else part for part in path), setting)
            else:
                _put(document, path, self._plain(argument.name, value))
        if self.plugin is not None:
            _put(document, ("target", "type"), self.plugin.kind)
            _put(document, ("target", "options"), dict(self.plugin.options))
        if self.adapter_overrides:
            _put(document, ("adapters", "override"), self._overrides())
        if self.update_if_exists:
            _put(document, ("sequence", "if_exists"), self._append())
        return document

    def _plain(self, name: str, value: Any) -> Any:  # noqa: ANN401 - any argument
        """Convert an argument's value to the form that the model accepts."""
        if name == "custom_msgs":
            return tuple(map(_custom_messages, value))
        if name == "topics" and isinstance(value, str):
            return (value,)
        if isinstance(value, Path):
            return str(value)
        if isinstance(value, RemotePath):
            return value.url
        return _enumerated(value)

    def _overrides(self) -> dict[str, AdapterReference]:
        overrides = {**(self.adapter_override or {})}
        for topic, adapter in (self.adapter_overrides or {}).items():
            if overrides.setdefault(topic, adapter) is not adapter:
                raise ManifestError(
                    f"adapter_override and adapter_overrides differ for {topic!r}", hint="keep one of the two"
                )
        return overrides

    def _append(self) -> IfExists:
        if self.if_exists not in {IfExists.FAIL, IfExists.APPEND}:
            raise ManifestError(
                f"update_if_exists is True and if_exists is {_enumerated(self.if_exists)!r}",
                hint="keep one of the two",
            )
        return IfExists.APPEND

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
        return ManifestError(error["msg"], hint="see the documentation of ROSInjectionConfig")


def _put(document: dict[str, Any], path: tuple[str, ...], value: object) -> None:
    for part in path[:-1]:
        document = document.setdefault(part, {})
    document[path[-1]] = value


def _enumerated(value: Any) -> Any:  # noqa: ANN401 - any argument
    """Return the value of an enumeration's member, because rosbags and the SDK have their own enumerations."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Mapping):
        return {key: _enumerated(inner) for key, inner in value.items()}
    return value


def _custom_messages(entry: tuple[str, Path | str, Stores | str | None]) -> dict[str, Any]:
    if len(entry) != 3:  # noqa: PLR2004 - as the hint says
        raise ManifestError(f"custom_msgs has {entry!r}", hint="give package, path, and a distro or None")
    package, path, store = entry
    return {"package": package, "path": str(path), "store": _enumerated(store)}


def _keys_of(value: object) -> tuple[object, ...]:
    return tuple(value) if isinstance(value, Mapping) else ()
