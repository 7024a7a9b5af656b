"""The sections of a job, which manifests, pipelines and plans share."""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from math import prod
from os.path import abspath
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Struct
from pydantic import (
    AfterValidator,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    SecretStr,
    SkipValidation,
    StringConstraints,
    Tag,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from mosaico_ingest.containers import RECORDING_NAME
from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.findings import Span
from mosaico_ingest.job.expect import Duration, Expectations, Frequency, SignedDuration
from mosaico_ingest.job.fields import (
    Count,
    FilePath,
    ImageFormat,
    ImageSettings,
    Literally,
    LoadedAdapter,
    MessageLimit,
    Parsed,
    PathRole,
    Secret,
    Section,
    Text,
    Time,
    Topic,
    TopicGlob,
    shape_of,
)
from mosaico_ingest.job.split import SequencePart, SplitSettings
from mosaico_ingest.job.values import (
    DEFAULT_MESSAGE_BYTES,
    DEFAULT_PORT,
    DEFAULT_STORE,
    DEFAULT_TOPIC,
    PROVENANCE_KEY,
    Compression,
    FileNamePattern,
    IfExists,
    LoaderErrorPolicy,
    LockFile,
    OnSchemaChange,
    PluginTarget,
    ServerTarget,
    SessionLevelErrorPolicy,
    StampSource,
    Stores,
    StoreTarget,
    Target,
    TopicLevelErrorPolicy,
    Unmodeled,
    first_match,
    is_glob,
    parse_size,
)
from mosaico_ingest.protocol import check_metadata, check_sequence_name, check_topic_name
from mosaico_ingest.remote import AnyPath, Network, RemotePath, as_path, with_network

VERSION = 1
"""The newest manifest version that this tool reads."""
MAX_JOBS = 1000
"""Maximum number of jobs that a matrix may expand to."""
SIDECAR_PLACEHOLDERS = ("stem", "name", "parent")
"""The placeholders of `sequence.metadata_from.sidecar`."""
KeyPath: TypeAlias = "tuple[str | int | float | bool | None, ...]"
_SIZES = range(1 << 20, (1 << 50) + 1)


def _bytes(text: str) -> int:
    size = parse_size(text)
    if size not in _SIZES:
        raise ValueError(f"{text!r} is out of range; write a size from 1MiB to 1024TiB")
    return size


def _check_variable(value: Any) -> str | int:  # noqa: ANN401 - any YAML value
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError("a variable's value must be text or a whole number")  # noqa: TRY004 - validators raise ValueError
    return value


def _check_matrix(value: Any) -> Any:  # noqa: ANN401 - one of two shapes
    if isinstance(value, dict) and prod(map(len, value.values())) > MAX_JOBS:
        raise ValueError(f"more than {MAX_JOBS} combinations")
    return value


def _matrix_form(value: Any) -> str:  # noqa: ANN401 - any YAML value
    return "combinations" if isinstance(value, list | tuple) else "axes"


def _check_sidecar(text: str) -> str:
    unknown = [word for word in re.findall(r"\{([^{}]*)\}", text) if word not in SIDECAR_PLACEHOLDERS]
    if unknown:
        names = ", ".join(f"{{{name}}}" for name in SIDECAR_PLACEHOLDERS)
        raise ValueError(f"unknown placeholder {{{unknown[0]}}}; the placeholders are {names}")
    return text


def _grouping(text: str) -> str | FileNamePattern:
    if text in {"auto", "none"}:
        return text
    pattern = FileNamePattern(text)
    if "split" not in pattern.names or "{split:int}" not in text:
        raise ValueError(
            f"{text!r} has no number of the split; write auto, none or a pattern with {{split:int}}"
        )
    return pattern


VariableName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
VariableValue = Annotated[
    Any, AfterValidator(_check_variable), WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer"}]})
]
Matrix = Annotated[
    Annotated[dict[VariableName, Annotated[tuple[VariableValue, ...], Field(min_length=1)]], Tag("axes")]
    | Annotated[
        tuple[dict[VariableName, VariableValue], ...],
        Field(min_length=1, max_length=MAX_JOBS),
        Tag("combinations"),
    ],
    Discriminator(_matrix_form),
    AfterValidator(_check_matrix),
]
Bytes = Annotated[int, Parsed(_bytes, r"^[0-9.]+ ?[kKMGT]?i?B$", to_json=int)]
Grouping = Annotated[str | FileNamePattern, Parsed(_grouping, r"^(auto|none)$|\{split:int\}")]
RecordingPath = Annotated[Text, FilePath(PathRole.RECORDING)]
BasePath = Annotated[Text, FilePath(PathRole.BASE)]
InputPath = Annotated[Text, FilePath(PathRole.INPUT)]
DefinitionsPath = Annotated[Text, FilePath(PathRole.DEFINITIONS)]
SchemaPath = Annotated[Text, FilePath(PathRole.SCHEMA)]
WorkerPath = Annotated[Text, FilePath(PathRole.WORKER_FILE)]
OutputPath = Annotated[Text, FilePath(PathRole.OUTPUT_FILE)]


class CustomMessages(Section):
    """Message definitions of one package, for recordings that do not contain them."""

    package: Text = Field(examples=["my_custom_pkg"])
    """The ROS package; the types are `<package>/msg/<file name>`."""
    path: DefinitionsPath = Field(examples=["definitions/my_pkg"])
    """A directory of `.msg` files, or one `.msg` file."""
    store: Stores | None = None
    """The distro that the definitions belong to; defaults to every distro."""


class TimeRange(Section):
    """Part of a recording, as offsets (`+10s` from the first message, `-5s` from the last) or instants."""

    start: Time | None = Field(default=None, examples=["+10s", "2026-03-01T12:00:00Z"])
    """The start, inclusive."""
    end: Time | None = Field(default=None, examples=["-5s", "2026-03-01T12:30:00Z"])
    """The end, exclusive."""
    include_latched: bool = True
    """Whether to include the latest message before the start of each latched topic (ROS 1: latching, ROS 2: transient local), and
    all messages of `/tf_static` before the start."""
    latched: tuple[Topic, ...] = Field(default=(), examples=[["/map", "/robot_description"]])
    """Names or globs of further topics whose latest message before the start is included."""


class BagSource(Section):
    """The recording, and the options for reading it."""

    path: Annotated[
        Annotated[RecordingPath, Tag("one")]
        | Annotated[tuple[RecordingPath, ...], Field(min_length=1), Tag("several")],
        Discriminator(shape_of),
    ] = Field(examples=["data/session_01.db3", ["part_0.mcap", "part_1.mcap"], "data/*.mcap"])
    """A file, a rosbag2 directory or a URL. A list names the splits of one recording. A glob makes one sequence for each
    match that is not hidden."""
    group: Grouping = Field(default="auto", examples=["none", "{stem}_{split:int}"])
    """Which matches of a glob are the splits of one recording. auto: files whose names differ only in the number after the last
    `_`, starting at 0. none: every match is a recording. A pattern of the file name with the field {split:int}: files whose
    other fields are the same."""
    ros_distro: Stores | None = Field(default=None, examples=["ros2_humble"])
    """The distro whose definitions are used if the recording does not contain its own."""
    custom_msgs: tuple[CustomMessages, ...] = ()
    """Definitions of messages that are in no distro."""
    time: TimeRange = TimeRange()
    """The part of the recording to ingest; defaults to all of it."""
    max_chunk_size: Bytes | None = Field(default=None, examples=["1GiB"])
    """Maximum decompressed size of a chunk; larger chunks are unreadable. Defaults to 256MiB."""


class MetadataSources(Section):
    """Sources of metadata that each recording fills on its own, in ascending order of precedence.

    `metadata` and `metadata_file` take precedence over all of them.
    """

    records: tuple[Text, ...] = Field(default=(), examples=[["vehicle", "drive_*"]])
    """Names or globs of metadata records of MCAP files (a `.db3` file has at most the record `rosbag2`); each entry of a record becomes a key. Its value is text, or what `metadata_schema` requires."""
    custom_data: bool = False
    """Whether to add the `custom_data` of rosbag2: from `metadata.yaml`, or else from its copy in the file. Its values are
    text, or what `metadata_schema` requires."""
    file_name: (
        Annotated[FileNamePattern, Parsed(FileNamePattern, r"\{[A-Za-z_][A-Za-z0-9_]*(:[^{}]+)?\}")] | None
    ) = Field(default=None, examples=["{vehicle}_{date:%Y%m%d}_{run:int}.mcap"])
    """A pattern of the recording's name: `{key}` is text, `{key:int}` and `{key:float}` are numbers, `{key:%Y%m%d}` is a date,
    `{_}` matches text that is ignored. A pattern with `/` also matches the folders."""
    sidecar: Annotated[Text, AfterValidator(_check_sidecar)] | None = Field(
        default=None, examples=["{stem}.json"]
    )
    """A JSON file for each recording, relative to the recording's folder; `{stem}` and `{name}` are the recording's name without
    and with the suffix, `{parent}` is the name of its folder."""


class KeepSettings(Section):
    """Content of the recording, besides messages, that the sequence keeps; exports write it again."""

    records: tuple[Text, ...] = Field(default=("*",), examples=[["vehicle", "drive_*"], []])
    """Names or globs of MCAP metadata records, which become the metadata `_records_`."""
    custom_data: bool = True
    """Whether the `custom_data` of rosbag2 becomes the metadata `_custom_data_`."""
    attachments: tuple[Text, ...] = Field(default=("*",), examples=[["*.yaml"], []])
    """Names or globs of MCAP attachments, which become files of the sequence."""


class SequenceSettings(Section):
    """The sequence that a recording becomes."""

    name: Text = Field(default="{stem}", examples=["Test_Run_01", "{parent}_{stem}"])
    """The sequence's name. Each recording fills in {stem} and {name} (its file name without and with the suffix), {parent}
    (its folder's name), {date} (the day of its last change), {index} (its position, from 1) and {index:03} (padded)."""
    family: Text | None = Field(default=None, examples=["delivery robots"])
    """Sequences of one family have the same message definitions, see `on_schema_change`; defaults to `name` as written."""
    metadata: dict[Text, JsonValue] = Field(
        default={}, examples=[{"driver_version": "v2.1", "weather": "sunny"}]
    )
    """Metadata of the sequence; any JSON."""
    metadata_file: InputPath | None = Field(default=None, examples=["metadata.json"])
    """A JSON file with more metadata; `metadata` takes precedence."""
    metadata_from: MetadataSources | None = None
    """Sources of metadata that each recording fills on its own: its name, its metadata records, a file next to it."""
    metadata_schema: SchemaPath | None = Field(default=None, examples=["fleet/vehicle.schema.json"])
    """A JSON Schema (draft 2020-12) for the final metadata. It may refer to other files (`$ref`), but not to URLs."""
    keep: KeepSettings = KeepSettings()
    """Content of the recording, besides messages, that the sequence keeps."""
    if_exists: IfExists = IfExists.FAIL
    """Action if the sequence exists: fail, skip (if its content is the same), append, replace."""


class TopicSettings(Section):
    """Settings of the topics that a name or glob matches."""

    rename: Text | None = Field(default=None, examples=["/sensors/imu"])
    """The topic's name in the sequence; only for a topic name, not for a glob."""
    metadata: dict[Text, JsonValue] = Field(default={}, examples=[{"mount": "roof"}])
    """Metadata of the topic."""
    metadata_schema: SchemaPath | None = Field(default=None, examples=["fleet/sensor.schema.json"])
    """A JSON Schema for the metadata of the topic, see `sequence.metadata_schema`."""
    stamp: StampSource = StampSource.LOG
    """The time that becomes `timestamp_ns`, and that `bag.time` and `rate` refer to: log, publish or header. Messages without
    the selected time have their log time; the report counts them."""
    time_offset: SignedDuration = Field(default=0, examples=["-250ms"])
    """A duration to add to every time of the topic, for a clock that is known to be wrong."""
    where: Text | None = Field(default=None, examples=["linear_acceleration.z > 5", "status.status >= 0"])
    """Keep messages for which this expression over their fields and `message.*` is true; its language is that of mappings."""
    on_change: tuple[Text, ...] = Field(default=(), examples=[["mode", "header.frame_id"]])
    """Keep messages for which one of these expressions differs from the previous message that `where` keeps."""
    every: Count = Field(default=1, examples=[3])
    """Keep the first of each `every` messages."""
    rate: Frequency | None = Field(default=None, examples=["10 Hz"])
    """Keep the first message of each interval of this frequency; the first interval starts at the topic's first message.
    The rules apply in the order `every`, `where`, `on_change`, `rate`."""
    image: Annotated[
        Annotated[ImageFormat, Tag("one")] | Annotated[ImageSettings, Tag("several")], Discriminator(shape_of)
    ] = Field(default="raw", examples=["png", {"format": "jpeg", "quality": 90, "max_width": 1280}])
    """The format of stored raw images (`raw`, `png`, `jpeg`, `buffer_png`), or a mapping with the format and its settings."""


def combined_settings(settings: Mapping[str, TopicSettings], topic: str) -> TopicSettings:
    """Return the settings of a topic, each from the topic's name or else from the first glob that defines the setting."""
    values: dict[str, Any] = {}
    for name in TopicSettings.model_fields:
        match = first_match(
            (glob for glob, entry in settings.items() if name in entry.model_fields_set), topic
        )
        if match is not None:
            values[name] = getattr(settings[match], name)
    return TopicSettings.model_construct(**values)


class AdapterSettings(Section):
    """The adapters that turn messages into ontology records in place of the built-in ones."""

    load: tuple[LoadedAdapter, ...] = Field(
        default=(),
        examples=[
            ["adapters/battery_pack.yaml", "my_pkg.adapters:WheelAdapter"],
            [{"file": "adapters/battery_pack.yaml", "with": {"cells": 12}}],
        ],
    )
    """Adapters for every topic of their types: YAML files, `module:Class` or `file.py:Class`. `{file: …, with: {…}}` sets
    parameters of a YAML file."""
    override: dict[Topic, LoadedAdapter] = Field(
        default={},
        examples=[
            {"/lidar/*": "LidarAdapter"},
            {"/pack/rear": {"file": "adapters/battery_pack.yaml", "with": {"cells": 24}}},
        ],
    )
    """The adapter for a topic name or glob, written as in `load` or as the name of a built-in adapter. The exact topic name
    takes precedence, followed by the first matching glob."""
    python: bool = True
    """Whether adapters in Python may run. With `false`, a reference to an adapter in Python is an error, and adapters of
    installed packages are not used. `ingest --no-python` does the same for every job."""
    unmodeled: Unmodeled = Unmodeled.KEEP
    """Action for a type without an adapter: keep its ROS shape, skip its topics, fail."""
    serialization_formats: dict[Text, Literal["default", "ragged", "image"]] = Field(
        default={}, examples=[{"acme_msgs/msg/Scan": "ragged"}]
    )
    """The platform's serialization format for types without an adapter, by message type."""


class ErrorPolicy(Section):
    """Whether an error affects one message, one topic, or the entire run."""

    session: SessionLevelErrorPolicy = SessionLevelErrorPolicy.Report
    """Action after an error that ends the run: report (keep the accepted rows and attach the error) or delete the session."""
    topic: Annotated[
        Annotated[TopicLevelErrorPolicy, Tag("one")]
        | Annotated[
            dict[Annotated[Text, TopicGlob(default=DEFAULT_TOPIC)], TopicLevelErrorPolicy], Tag("several")
        ],
        Discriminator(shape_of),
    ] = Field(
        default=TopicLevelErrorPolicy.Raise, examples=["raise", {"default": "raise", "/gps/*": "ignore"}]
    )
    """Action after an error in a topic: raise (end the run), ignore (reject the message), finalize (close the topic). One
    action, or one for each topic name or glob, with `default` for the other topics. The exact topic name takes precedence,
    followed by the first matching glob."""
    message: LoaderErrorPolicy = LoaderErrorPolicy.LOG_WARN
    """Action for messages that cannot be decoded: `ignore` counts them, `log_warn` also logs a warning, `raise` ends the
    run."""

    def for_topic(self, topic: str) -> TopicLevelErrorPolicy:
        """Return the action after an error in a topic."""
        if isinstance(self.topic, TopicLevelErrorPolicy):
            return self.topic
        match = first_match((glob for glob in self.topic if glob != DEFAULT_TOPIC), topic)
        return self.topic.get(match or DEFAULT_TOPIC, TopicLevelErrorPolicy.Raise)


class QuarantineSettings(Section):
    """The quarantine, which keeps rejected messages for `ingest replay`; `on_error` applies only beyond its limits."""

    path: Annotated[Text, FilePath(PathRole.OUTPUT_FOLDER)] = Field(
        default="quarantine", examples=["quarantine"]
    )
    """The folder for the messages' bytes (MCAP) and the reasons of their rejection (JSONL)."""
    max: MessageLimit | None = Field(default=None, examples=[100, "0.1%"])
    """Maximum number of rejected messages kept per topic, or their share of the topic's messages. Beyond this limit,
    `on_error.topic` applies. Defaults to no limit."""
    max_run: MessageLimit | None = Field(default=None, examples=[1000, "0.01%"])
    """Maximum number or share of rejected messages kept of all topics together."""
    systematic: Count = 100
    """Number of consecutive rejections from a topic's first message after which the topic ends: its definition or mapping is
    wrong."""


class DestinationSettings(Section):
    """Where sequences are written: a store of files or a Mosaico server; defaults to the store `./mosaico`."""

    store: Annotated[Text, FilePath(PathRole.STORE)] | None = Field(default=None, examples=["./mosaico"])
    """The directory of the embedded store, or a URL (`s3://bucket/prefix`, `gs://bucket/prefix`)."""
    compression: Compression = Compression.FAST
    """The compression of the store: fast, or small (fewer bytes, more CPU time; only the size of the files differs)."""
    host: Text | None = Field(default=None, examples=["mosaico.example.org"])
    """The server's name or address."""
    port: Annotated[int, Field(ge=1, le=65535)] = DEFAULT_PORT
    """The server's port."""
    api_key: Annotated[SecretStr, Secret()] | None = Field(
        default=None, examples=["${MOSAICO_API_KEY:?a key with write permission}"]
    )
    """A key with write permission; take it from the environment."""
    tls_cert: WorkerPath | None = Field(default=None, examples=["certs/ca.pem"])
    """The CA certificate to trust; implies `tls`."""
    tls: bool = False
    """Whether the connection is encrypted; without `tls_cert` the system's certificates are trusted."""
    message_size: Bytes = Field(default=DEFAULT_MESSAGE_BYTES, examples=["4MB"])
    """The size up to which rows are combined into one upload message; a larger row is a message of its own."""
    type: Text | None = Field(default=None, examples=["lake"])
    """The name of a destination that an installed package provides, in place of `store` and `host`."""
    options: dict[Text, JsonValue] = Field(default={}, examples=[{"bucket": "recordings"}])
    """The options of this destination; the package that provides it defines them."""

    @model_validator(mode="after")
    def _check_one_destination(self) -> DestinationSettings:
        kinds = [key for key in ("store", "host", "type") if getattr(self, key) is not None]
        if len(kinds) > 1:
            raise _conflict(f"{kinds[0]} and {kinds[1]} are two destinations", kinds[1])
        if self.options and self.type is None:
            raise _conflict("options are set, but type is not", "options")
        if "compression" in self.model_fields_set and kinds and "store" not in kinds:
            raise _conflict(
                f"compression is an option of store, and {kinds[0]} is another destination", "compression"
            )
        server_only = sorted(self.model_fields_set - {"store", "compression", "host", "type", "options"})
        if self.host is None and server_only:
            raise _conflict(f"{server_only[0]} requires host, which is not set", server_only[0])
        return self

    def target(self, folder: Path) -> Target:
        """Return the store, server or installed destination; `folder` is where relative paths of `options` start."""
        if self.type is not None:
            return PluginTarget(self.type, self.options, folder)
        if self.host is None:
            path = DEFAULT_STORE if self.store is None else as_path(self.store)
            return StoreTarget(path, self.compression)
        key = None if self.api_key is None else self.api_key.get_secret_value()
        certificate = None if self.tls_cert is None else Path(self.tls_cert)
        return ServerTarget(
            self.host, self.port, key, certificate, self.tls or certificate is not None, self.message_size
        )


def _conflict(message: str, key: str) -> PydanticCustomError:
    return PydanticCustomError("conflicting-keys", "{message}", {"key": key, "message": message})


class NetworkSettings(Section):
    """Timeouts and retries of the requests for recordings and stores behind URLs."""

    attempts: Annotated[int, Field(ge=1, le=100)] = 5
    """Maximum number of attempts per request; the delay between attempts doubles. Google Cloud Storage retries for the time of
    `timeout` instead."""
    connect_timeout: Duration = Field(default=5 * 10**9, examples=["10 s"])
    """Maximum time to establish a connection."""
    timeout: Duration = Field(default=30 * 10**9, examples=["2 min"])
    """Maximum time between two parts of a response."""
    max_download: Bytes | None = Field(default=None, examples=["20GiB"])
    """Maximum size of a recording that cannot be read by range and is therefore downloaded; larger recordings are refused. Defaults
    to the free space of the temporary folder."""

    @property
    def limits(self) -> Network:
        """The settings in the form that paths use."""
        return Network(self.attempts, self.connect_timeout / 1e9, self.timeout / 1e9, self.max_download)


class RunOptions(Section):
    """Options of a run; none of them changes the stored content."""

    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"] = "INFO"
    """The least severe log messages to show on the terminal."""
    report: OutputPath | None = Field(default=None, examples=["report.json"])
    """The file to write the run's report to."""
    memory: Bytes | None = Field(default=None, examples=["512MiB"])
    """Maximum memory of batches, for all `jobs` together; from 1MiB to 1024TiB, defaults to 256MiB."""
    jobs: Annotated[int, Field(ge=1, le=1024)] = 1
    """Maximum number of recordings to ingest at the same time."""


class _Composition(Section):
    """The keys that are resolved before the job is built."""

    version: Annotated[int, Field(ge=1, le=VERSION)] = VERSION
    """The version of the manifest language."""
    extends: (
        Annotated[
            Annotated[BasePath, Tag("one")]
            | Annotated[tuple[BasePath, ...], Field(min_length=1), Tag("several")],
            Discriminator(shape_of),
        ]
        | None
    ) = Field(default=None, examples=["base.yaml", ["fleet.yaml", "night.yaml"]])
    """Manifests, or parts of them, that provide the keys that this one does not set. Mappings are merged key by key; later
    files take precedence."""
    defaults: Annotated[dict[VariableName, VariableValue], Literally()] = Field(
        default={}, examples=[{"VEHICLE": "demo-01"}]
    )
    """Values of `${NAME}` that neither the matrix nor the environment sets."""
    matrix: Annotated[Matrix, Literally()] | None = Field(
        default=None,
        examples=[{"vehicle": ["a", "b"], "day": ["monday", "tuesday"]}, [{"vehicle": "a", "day": "monday"}]],
    )
    """Values of `${NAME}`, with one job for each combination; or a list of the combinations."""


class JobSettings(Section):
    """The sections of a job."""

    bag: BagSource
    """The recording, and the options for reading it."""
    sequence: SequenceSettings = SequenceSettings()
    """The sequence that a recording becomes."""
    split: SplitSettings | None = None
    """One recording becomes several sequences: parts of equal length (`by`), or the intervals of a file (`events`)."""
    topics: tuple[Annotated[Text, TopicGlob(excludes=True)], ...] = Field(
        default=(), examples=[["/cam*", "!/cam/debug*"]]
    )
    """Topic names and globs; the last match decides, a leading `!` excludes, `*` also matches `/`. Defaults to every topic."""
    topic_settings: dict[Topic, TopicSettings] = Field(default={}, examples=[{"/camera/*": {"every": 3}}])
    """Settings per topic name or glob. For each setting, the exact topic name takes precedence, followed by the first matching
    glob that defines the setting."""
    adapters: AdapterSettings = AdapterSettings()
    """The adapters that turn messages into ontology records in place of the built-in ones."""
    on_error: ErrorPolicy = ErrorPolicy()
    """Whether an error affects one message, one topic, or the entire run."""
    on_schema_change: OnSchemaChange | None = None
    """Action if a topic's message definition differs from that of earlier sequences of the family: fail, evolve (warn and
    store the new columns), new_topic (store it under another name). If omitted, definitions are not compared."""
    expect: Expectations | None = None
    """The data contract: expectations of the recording, its topics and their values, and the action if one fails."""
    definitions: Literal["locked"] | None = None
    """With `locked`, a recording must have the topics, message definitions and output columns of the lock file, which
    `ingest schema lock` writes next to the manifest (`job.lock.json` for `job.yaml`). If omitted, they are not compared."""
    quarantine: QuarantineSettings | None = None
    """Where rejected messages are kept; without this section, they are only counted."""
    target: DestinationSettings = DestinationSettings()
    """Where sequences are written."""
    network: NetworkSettings = NetworkSettings()
    """Timeouts and retries of the requests for recordings and stores behind URLs."""
    run: RunOptions = RunOptions()
    """Options of a run."""


class Manifest(JobSettings, _Composition):
    """A job: which recordings to ingest, how to convert them, and where to store the results."""


class Origin(Struct, frozen=True):
    """The manifest that a job comes from."""

    file: str | None = None
    """Its path; None for a job built in Python."""
    folder: Path = Path()
    """The folder where the relative paths of adapters start."""
    spans: Mapping[KeyPath, Span] = {}
    """The span of each value, by key path."""
    key_spans: Mapping[KeyPath, Span] = {}
    """The span of each key, by key path."""


class Job(JobSettings):
    """The job of one recording: its variables and name are filled in, and its paths start at the current folder."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    paths: SkipValidation[tuple[Path | RemotePath, ...]]
    """The recording's splits."""
    origin: SkipValidation[Origin] = Field(default=Origin(), repr=False)
    lock: SkipValidation[LockFile | None] = Field(default=None, repr=False)
    """The lock file, if `definitions` is `locked`."""
    part: SkipValidation[SequencePart | None] = Field(default=None, repr=False)
    """The part that the sequence consists of, if `split` divides the recording."""
    registry: SkipValidation[Any] = Field(default=None, repr=False)
    """The `ROSTypeRegistry` for definitions; None selects the process-wide registry."""

    @property
    def folder(self) -> Path:
        """The folder where the relative paths of adapters start."""
        return self.origin.folder

    @property
    def family(self) -> str:
        """The name that sequences with the same message definitions share."""
        return self.sequence.family or self.sequence.name

    @property
    def main_path(self) -> AnyPath:
        """The path that names the recording: a directory for its `metadata.yaml`."""
        first = self.paths[0]
        main = first.parent if first.name == "metadata.yaml" else first
        return Path(abspath(main)) if isinstance(main, Path) else main  # noqa: PTH100 - keep the names of links

    @property
    def sidecar(self) -> AnyPath | None:
        """The path of the recording's side-car file, which need not exist; None if the job has no such source."""
        sources = self.sequence.metadata_from
        if sources is None or sources.sidecar is None:
            return None
        path = self.main_path
        texts = {"stem": RECORDING_NAME.sub("", path.name), "name": path.name, "parent": path.parent.name}
        return path.parent / re.sub(r"\{(\w+)\}", lambda match: texts[match[1]], sources.sidecar)

    @property
    def destination(self) -> Target:
        """The store, server or installed destination that the sequence is written to."""
        target = self.target.target(self.folder)
        if isinstance(target, StoreTarget):
            return StoreTarget(with_network(target.path, self.network.limits))
        return target

    def span(self, *path: str | int) -> Span | None:
        """Return the span of a key or list item in the manifest, None if the manifest does not have it."""
        return self.origin.key_spans.get(path) or self.origin.spans.get(path)

    def value_span(self, *path: str | int) -> Span | None:
        """Return the span of a value in the manifest, None if the manifest does not have it."""
        return self.origin.spans.get(path)

    def where(self, *path: str | int) -> str | None:
        """Return `file:line:column` of a value or of what contains it, or the file; None without a manifest."""
        for length in range(len(path), 0, -1):
            span = self.origin.spans.get(path[:length])
            if span is not None:
                return str(span)
        return self.origin.file

    def settings_of(self, topic: str) -> TopicSettings:
        """Return the settings of a topic, each from the topic's name or else from the first glob that defines the setting."""
        return combined_settings(self.topic_settings, topic)

    def check_name(self) -> Self:
        """Return the job if the platform accepts its name.

        Raises:
            ManifestError: The platform refuses the name.
        """
        with _located(self, "sequence", "name"):
            check_sequence_name(self.sequence.name)
        return self

    def check(self) -> Self:
        """Return the job if the platform accepts its names and metadata.

        Raises:
            ManifestError: The platform refuses a name or metadata, or a run uses the metadata key itself.
        """
        self.check_name()
        with _located(self, "sequence", "metadata"):
            check_metadata(self.sequence.metadata, where="")
        if PROVENANCE_KEY in self.sequence.metadata:
            raise ManifestError(
                f"the metadata key {PROVENANCE_KEY!r} is reserved for the sequence's provenance",
                where=self.where("sequence", "metadata", PROVENANCE_KEY) or "metadata",
                hint="use another key",
            )
        for topic, settings in self.topic_settings.items():
            with _located(self, "topic_settings", topic, "metadata"):
                check_metadata(settings.metadata, where="")
            with _located(self, "topic_settings", topic, "rename"):
                if settings.rename is not None:
                    check_topic_name(settings.rename)
                    _check_one_topic(topic, settings.rename)
        return self


def _check_one_topic(topic: str, name: str) -> None:
    if is_glob(topic):
        raise SinkError(
            f"every topic that {topic!r} matches would be renamed to {name!r}", hint="name one topic"
        )


@contextmanager
def _located(job: Job, *path: str) -> Generator[None]:
    """Convert a `SinkError` to a `ManifestError` with the location of a key path."""
    try:
        yield
    except SinkError as error:
        where = job.where(*path) or ".".join(path)
        raise ManifestError(error.what, where=where, hint=error.hint) from error
