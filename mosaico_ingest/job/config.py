"""This file is the job as a Python value: what a script builds by hand, a manifest compiles to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args

from msgspec import Struct

from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.findings import Span
from mosaico_ingest.job.patterns import first_match
from mosaico_ingest.job.values import (
    DEFAULT_MESSAGE_BYTES,
    DEFAULT_PORT,
    DEFAULT_STORE,
    DEFAULT_TOPIC,
    PROVENANCE_KEY,
    IfExists,
    Limit,
    LoaderErrorPolicy,
    OnSchemaChange,
    PluginTarget,
    ServerTarget,
    SessionLevelErrorPolicy,
    Stores,
    StoreTarget,
    Target,
    TimeBound,
    TopicLevelErrorPolicy,
    Unmodeled,
)
from mosaico_ingest.protocol import check_metadata, check_sequence_name, check_topic_name
from mosaico_ingest.remote import AnyPath, RemotePath, as_path

__all__ = [
    "AdapterReference",
    "Attempt",
    "ImageFormat",
    "LogLevel",
    "QuarantineSettings",
    "ROSInjectionConfig",
    "TimeRange",
]

AdapterReference: TypeAlias = Any
"""An adapter: a class, an `AdapterSpec`, or how to find one: `module:Class`, `file.py:Class`, a YAML path, a name."""
ImageFormat: TypeAlias = Literal["raw", "png"]
LogLevel: TypeAlias = Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"]
CustomMessages: TypeAlias = tuple[str, Path, Stores | None]
_LISTS = ("custom_msgs", "adapters")
_MAPPINGS = (
    "metadata", "adapter_override", "adapter_overrides", "topic_metadata", "serialization_formats", "images", "rename",
    "every",
)  # fmt: skip
_Choice = TypeVar("_Choice", bound=Enum)


class TimeRange(Struct, frozen=True):
    """Part of a recording: `start` is in, `end` is out; None is its own start or end."""

    start: TimeBound | None = None
    end: TimeBound | None = None


class QuarantineSettings(Struct, frozen=True):
    """Where rejected messages are kept and how many: of one topic, and of all together (None: all of them)."""

    path: Path = Path("quarantine")
    max: Limit | None = None
    max_run: Limit | None = None
    systematic: int = 100
    """So many failures from the very start of a topic end it."""


class Attempt(Struct, frozen=True):
    """Which try of which run this is: a later one takes back what an earlier one committed before it died."""

    run: str
    number: int = 1


@dataclass(frozen=True, slots=True)
class ROSInjectionConfig:
    """A job: which recording becomes which sequence, how, and where it goes.

    Nothing said about the destination is the embedded store `./mosaico`, a `store` is that store, a `host` a server.

    Raises:
        ManifestError: A value is not what it must be, two contradict each other, or the platform refuses a name or the metadata.
    """

    file_path: AnyPath | str | Sequence[AnyPath | str]
    """A file or rosbag2 directory, or the URL of one; several are the parts of one recording."""
    sequence_name: str
    metadata: Mapping[str, Any] = field(default_factory=dict[str, Any])
    host: str | None = None
    port: int = DEFAULT_PORT
    ros_distro: Stores | str | None = None
    """Used where the recording does not carry its definitions."""
    on_error: SessionLevelErrorPolicy = SessionLevelErrorPolicy.Report
    topics_on_error: TopicLevelErrorPolicy | Mapping[str, TopicLevelErrorPolicy] = TopicLevelErrorPolicy.Raise
    """One policy, or one for each topic name or glob, `default` for the others (raise where it is not given)."""
    custom_msgs: Sequence[tuple[str, Path | str, Stores | str | None]] = ()
    """Package, directory of `.msg` files or one file, distro (None: every one)."""
    topics: Sequence[str] | str | None = ()
    """Globs in order, `!` leaves out; none: every topic."""
    adapter_override: Mapping[str, AdapterReference] = field(default_factory=dict[str, AdapterReference])
    """The adapter for a topic name or glob."""
    adapter_overrides: Mapping[str, AdapterReference] = field(default_factory=dict[str, AdapterReference])
    """Another spelling of `adapter_override`; both hold the same once made."""
    log_level: LogLevel = "INFO"
    mosaico_api_key: str | None = field(default=None, repr=False)
    tls_cert_path: Path | str | None = None
    enable_tls: bool = False
    topic_metadata: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    """By topic name or glob."""
    update_if_exists: bool = False
    """The same as `if_exists=IfExists.APPEND`."""
    serialization_formats: Mapping[str, str] = field(default_factory=dict[str, str])
    """By message type, for types without an adapter."""
    dry_run: bool = False
    """Plan, and write nothing."""
    registry: Any = None
    """The `ROSTypeRegistry` to look definitions up in; None: the process-wide one."""
    store: AnyPath | str | None = None
    """The directory of the embedded store, or a URL as `s3://bucket/prefix`."""
    if_exists: IfExists = IfExists.FAIL
    messages_on_error: LoaderErrorPolicy = LoaderErrorPolicy.LOG_WARN
    adapters: Sequence[AdapterReference] = ()
    """Adapters that serve every topic of their types, before the built-in ones."""
    unmodeled: Unmodeled = Unmodeled.KEEP
    base_dir: Path = Path()
    """Where the relative paths of adapter references start."""
    time_range: TimeRange = field(default_factory=TimeRange)
    images: Mapping[str, ImageFormat] = field(default_factory=dict[str, ImageFormat])
    """How raw images are stored, by topic name or glob; raw where it is not given."""
    rename: Mapping[str, str] = field(default_factory=dict[str, str])
    """The name in the sequence, by topic name."""
    every: Mapping[str, int] = field(default_factory=dict[str, int])
    """Keep one message in so many, by topic name or glob."""
    report_path: Path | str | None = None
    memory_bytes: int | None = None
    """How much memory batches may take."""
    jobs: int = 1
    """How many recordings are ingested at the same time, where there are several."""
    where: str | None = field(default=None, compare=False)
    """The manifest this came from, for messages."""
    places: Mapping[tuple[str | int | float | bool | None, ...], Span] = field(
        default_factory=dict[tuple[str | int | float | bool | None, ...], Span], compare=False, repr=False
    )
    """Where the manifest says what: of a key its place, of a list's item the item's, by their path."""
    quarantine: QuarantineSettings | None = None
    """Where rejected messages are kept; None: they are only counted."""
    family: str | None = None
    """What sequences with the same topics have in common; None: the sequence is alone."""
    on_schema_change: OnSchemaChange | None = None
    """What to do when a topic's definition is not what it was in the family; None: it is not compared."""
    plan_digest: str | None = None
    """The `digest` of the only plan that may be run; None: whatever the recording calls for."""
    attempt: Attempt | None = None
    """Set by executors that may begin a recording more than once."""
    code_dir: Path | None = None
    """Where the relative paths of adapter references start instead of `base_dir`, on a machine they were sent to."""
    message_bytes: int = DEFAULT_MESSAGE_BYTES
    """The size up to which rows are combined into one upload message to a server."""
    plugin: PluginTarget | None = None
    """A destination that an installed package provides, instead of `store` and `host`."""

    def __post_init__(self) -> None:
        """Bring every value into its one form and check it."""
        self._fill_in()
        self._normalise_recording()
        self._normalise_policies()
        self._normalise_adapters()
        self._check_destination()
        try:
            self._check_topics()
            check_sequence_name(self.sequence_name)
            check_metadata(self.metadata, where=self.where or "metadata")
        except SinkError as error:
            raise ManifestError(error.what, where=error.where, hint=error.hint) from error
        if PROVENANCE_KEY in self.metadata:
            raise ManifestError(
                f"the metadata key {PROVENANCE_KEY!r} is where a run notes what the sequence was made from",
                where=self.where or "metadata",
                hint="use another key",
            )

    @property
    def paths(self) -> tuple[AnyPath, ...]:
        """The parts of the recording; one, mostly."""
        if isinstance(self.file_path, Path | str | RemotePath):
            return (as_path(self.file_path),)
        return tuple(as_path(path) for path in self.file_path)

    @property
    def target(self) -> Target:
        """Where the sequence goes."""
        if self.plugin is not None:
            return self.plugin
        if self.host is None:
            return StoreTarget(as_path(self.store) if self.store is not None else DEFAULT_STORE)
        cert = Path(self.tls_cert_path) if self.tls_cert_path is not None else None
        return ServerTarget(
            self.host,
            self.port,
            self.mosaico_api_key,
            cert,
            self.enable_tls or cert is not None,
            self.message_bytes,
        )

    def topic_policy(self, topic: str) -> TopicLevelErrorPolicy:
        """Return what an error in `topic` does to the rest."""
        if isinstance(self.topics_on_error, TopicLevelErrorPolicy):
            return self.topics_on_error
        policies = dict(self.topics_on_error)
        default = policies.pop(DEFAULT_TOPIC, TopicLevelErrorPolicy.Raise)
        match = first_match(policies, topic)
        return default if match is None else policies[match]

    def _fill_in(self) -> None:
        """Take None for nothing, as programs written for the official bridge do."""
        for name in _LISTS:
            if getattr(self, name) is None:
                self._set(name, ())
        for name in _MAPPINGS:
            value = getattr(self, name)
            if value is None:
                self._set(name, {})
            elif not isinstance(value, Mapping):
                raise self._error(f"{name} is {value!r:.80}", "give a mapping")

    def _normalise_recording(self) -> None:
        paths = self.paths
        if not paths:
            raise self._error("file_path is empty", "name a recording")
        self._set("file_path", paths[0] if len(paths) == 1 else paths)
        self._set("ros_distro", self._distro(self.ros_distro))
        for one in self.custom_msgs:
            if len(one) != 3:  # noqa: PLR2004 - as the hint says
                raise self._error(f"custom_msgs has {one!r}", "give package, path, and a distro or None")
        custom = tuple(
            (package, Path(path), self._distro(store)) for package, path, store in self.custom_msgs
        )
        self._set("custom_msgs", custom)
        topics = (self.topics,) if isinstance(self.topics, str) else tuple(self.topics or ())
        self._set("topics", topics)

    def _normalise_policies(self) -> None:
        self._set("on_error", self._choice(SessionLevelErrorPolicy, self.on_error, "on_error"))
        self._set("topics_on_error", self._topic_policies(self.topics_on_error))
        self._set(
            "messages_on_error", self._choice(LoaderErrorPolicy, self.messages_on_error, "messages_on_error")
        )
        self._set("unmodeled", self._choice(Unmodeled, self.unmodeled, "unmodeled"))
        self._set("if_exists", self._choice(IfExists, self.if_exists, "if_exists"))
        if self.update_if_exists:
            if self.if_exists not in {IfExists.FAIL, IfExists.APPEND}:
                raise self._error(
                    f"update_if_exists says append and if_exists says {self.if_exists.value}",
                    "keep one of the two",
                )
            self._set("if_exists", IfExists.APPEND)
        if self.log_level not in get_args(LogLevel):
            raise self._error(f"log_level is {self.log_level!r}", f"allowed: {', '.join(get_args(LogLevel))}")

    def _topic_policies(self, given: object) -> object:
        if not isinstance(given, Mapping):
            return self._choice(TopicLevelErrorPolicy, given, "topics_on_error")
        return {
            topic: self._choice(TopicLevelErrorPolicy, policy, f"topics_on_error[{topic!r}]")
            for topic, policy in given.items()
        }

    def _normalise_adapters(self) -> None:
        both = {**self.adapter_overrides, **self.adapter_override}
        differing = [
            topic for topic in self.adapter_overrides if both[topic] is not self.adapter_overrides[topic]
        ]
        if differing:
            what = f"adapter_override and adapter_overrides disagree on {differing[0]!r}"
            raise self._error(what, "keep one of the two")
        self._set("adapter_override", both)
        self._set("adapter_overrides", both)
        self._set("adapters", tuple(self.adapters))

    def _check_destination(self) -> None:
        if self.host is not None and self.store is not None:
            raise self._error(
                f"store {str(self.store)!r} and host {self.host!r} are two targets", "keep one of the two"
            )
        if self.plugin is not None and (self.host is not None or self.store is not None):
            raise self._error(
                f"plugin {self.plugin.kind!r} and {'store' if self.host is None else 'host'} are two targets",
                "keep one of the two",
            )
        if not 1 <= self.port <= 65535:  # noqa: PLR2004 - TCP's range
            raise self._error(f"port is {self.port}", "it must be from 1 to 65535")
        server_only = {"mosaico_api_key": self.mosaico_api_key, "tls_cert_path": self.tls_cert_path}
        for name, value in server_only.items():
            if value is not None and self.host is None:
                raise self._error(f"{name} says how to reach a server, and no host is named", "set host")

    def _check_topics(self) -> None:
        for topic, metadata in self.topic_metadata.items():
            check_metadata(metadata, where=f"{self.where or 'topic_metadata'}: topic {topic}")
        for topic, name in self.rename.items():
            self._check_new_name(topic, name)
            if any(character in topic for character in "*?["):
                raise self._error(f"rename[{topic!r}] is for every topic of a glob", "name one topic")
        for topic, step in self.every.items():
            if step < 1:
                raise self._error(f"every[{topic!r}] is {step}", "it must be at least 1")
        for topic, image in self.images.items():
            if image not in get_args(ImageFormat):
                raise self._error(
                    f"images[{topic!r}] is {image!r}", f"allowed: {', '.join(get_args(ImageFormat))}"
                )
        if self.jobs < 1:
            raise self._error(f"jobs is {self.jobs}", "it must be at least 1")

    def _distro(self, value: Stores | str | None) -> Stores | None:
        return None if value is None else self._choice(Stores, value, "ros_distro")

    def _choice(self, kind: type[_Choice], value: object, name: str) -> _Choice:
        try:
            # rosbags and the SDK have enumerations of their own
            return kind(value.value if isinstance(value, Enum) else value)
        except ValueError as err:
            allowed = ", ".join(str(choice.value) for choice in kind)
            raise self._error(f"{name} is {value!r}", f"allowed: {allowed}") from err

    def _check_new_name(self, topic: str, name: str) -> None:
        try:
            check_topic_name(name)
        except SinkError as error:
            error.where = f"{self.where or 'rename'}: topic {topic}"
            raise

    def _error(self, what: str, hint: str) -> ManifestError:
        return ManifestError(what, where=self.where, hint=hint)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)  # frozen for everyone else
