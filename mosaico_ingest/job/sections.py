"""This file is the manifest's keys: their types, defaults, descriptions and examples, said once."""

from __future__ import annotations

from math import prod
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    JsonValue,
    SecretStr,
    StringConstraints,
    Tag,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError

from mosaico_ingest.job.compose import MAX_JOBS
from mosaico_ingest.job.units import (
    parse_instant,
    parse_limit,
    parse_offset,
    parse_size,
)
from mosaico_ingest.job.values import (
    IfExists,
    LoaderErrorPolicy,
    OnSchemaChange,
    SessionLevelErrorPolicy,
    Stores,
    TopicLevelErrorPolicy,
    Unmodeled,
)

__all__ = [
    "VERSION",
    "AdaptersSection",
    "BagSection",
    "CustomMessages",
    "Manifest",
    "OnErrorSection",
    "QuarantineSection",
    "RunSection",
    "SequenceSection",
    "TargetSection",
    "TimeSection",
    "TopicSettings",
]

VERSION = 1
"""The newest manifest version this tool reads."""


def _check_time(text: str) -> str:
    (parse_offset if text[:1] in {"+", "-"} else parse_instant)(text)
    return text


def _check_memory(text: str) -> str:
    if parse_size(text) < _MIN_MEMORY:
        raise ValueError(f"{text!r} is less than 1 MiB")
    return text


_MIN_MEMORY = 1 << 20
"""Minimum of `run.memory` in bytes."""


def _limit_text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _check_limit(text: str) -> str:
    parse_limit(text)
    return text


def _shape(value: Any) -> str:  # noqa: ANN401 - whatever YAML holds
    return "several" if isinstance(value, list | tuple | dict) else "one"


def _check_cell(value: Any) -> str | int:  # noqa: ANN401 - whatever YAML holds
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise ValueError("a variable's value is a text or a whole number")  # noqa: TRY004 - pydantic's way to refuse
    return value


def _check_matrix(value: Any) -> Any:  # noqa: ANN401 - one of two shapes
    if isinstance(value, dict) and prod(map(len, value.values())) > MAX_JOBS:
        raise ValueError(f"more than {MAX_JOBS} combinations")
    return value


def _axes_or_cells(value: Any) -> str:  # noqa: ANN401 - whatever YAML holds
    return "cells" if isinstance(value, list | tuple) else "axes"


Text = Annotated[str, StringConstraints(min_length=1)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Cell = Annotated[
    Any,
    AfterValidator(_check_cell),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer"}]}),
]
Matrix = Annotated[
    Annotated[dict[Name, Annotated[tuple[Cell, ...], Field(min_length=1)]], Tag("axes")]
    | Annotated[tuple[dict[Name, Cell], ...], Field(min_length=1, max_length=MAX_JOBS), Tag("cells")],
    Discriminator(_axes_or_cells),
    AfterValidator(_check_matrix),
]
TimeText = Annotated[
    Text,
    AfterValidator(_check_time),
    Field(json_schema_extra={"pattern": r"^([+-][0-9.]+ ?(ns|us|ms|s|min|h)|[0-9]{4}-[0-9]{2}-[0-9]{2}.*)$"}),
]
SizeText = Annotated[
    Text, AfterValidator(_check_memory), Field(json_schema_extra={"pattern": r"^[0-9.]+ ?[kKMGT]?i?B$"})
]
LimitText = Annotated[
    Text,
    BeforeValidator(_limit_text),
    AfterValidator(_check_limit),
    Field(
        json_schema_extra={
            "type": ["string", "integer"],
            "minimum": 0,
            "pattern": r"^[0-9]+$|^0*(100(\.0*)?|[0-9]{1,2}(\.[0-9]+)?) ?%$",
        }
    ),
]
Paths = Annotated[
    Annotated[Text, Tag("one")] | Annotated[tuple[Text, ...], Field(min_length=1), Tag("several")],
    Discriminator(_shape),
]
TopicPolicies = Annotated[
    Annotated[TopicLevelErrorPolicy, Tag("one")]
    | Annotated[dict[Text, TopicLevelErrorPolicy], Tag("several")],
    Discriminator(_shape),
]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class CustomMessages(_Section):
    """Message definitions of one package, for recordings that do not carry them."""

    package: Text = Field(examples=["my_custom_pkg"])
    """The ROS package; the types become `<package>/msg/<file name>`."""
    path: Text = Field(examples=["definitions/my_pkg"])
    """A directory of `.msg` files, or one `.msg` file."""
    store: Stores | None = None
    """The distro the definitions belong to; without it they serve every one."""


class TimeSection(_Section):
    """Which part of the recording: offsets (`+10s` from the first message, `-5s` from the last) or instants."""

    start: TimeText | None = Field(default=None, examples=["+10s", "2026-03-01T12:00:00Z"])
    """The first moment that is in."""
    end: TimeText | None = Field(default=None, examples=["-5s", "2026-03-01T12:30:00Z"])
    """The first moment that is out again."""


class BagSection(_Section):
    """The recording, and what it takes to read it."""

    path: Paths = Field(examples=["data/session_01.db3", ["part_0.mcap", "part_1.mcap"], "data/*.mcap"])
    """A file or rosbag2 directory, or the URL of one; a list: the parts of one recording; a glob: one sequence for each
    match that is not hidden."""
    ros_distro: Stores | None = Field(default=None, examples=["ros2_humble"])
    """The distro whose definitions are used where the recording does not carry its own."""
    custom_msgs: tuple[CustomMessages, ...] = ()
    """Definitions of messages that are in no distro."""
    time: TimeSection | None = None
    """Which part of the recording; all of it without this."""


class SequenceSection(_Section):
    """What the recording becomes."""

    name: Text = Field(default="{stem}", examples=["Test_Run_01", "{parent}_{stem}"])
    """The sequence's name; filled in for each recording: {stem} and {name}, the file's name without and with its suffix,
    {parent}, its folder's, {date}, the day it was last changed, {index}, its position from 1, {index:03} padded."""
    family: Text | None = Field(default=None, examples=["delivery robots"])
    """What this sequence shares its topics' definitions with, for `on_schema_change`; `name` as it is written here,
    without this."""
    metadata: dict[Text, JsonValue] = Field(
        default={}, examples=[{"driver_version": "v2.1", "weather": "sunny"}]
    )
    """What to know about the sequence; anything JSON can say."""
    metadata_file: Text | None = Field(default=None, examples=["metadata.json"])
    """A JSON file with more metadata; what `metadata` says wins."""
    if_exists: IfExists = IfExists.FAIL
    """What to do when the name is taken: fail, skip (the same content is there), append, replace."""


class TopicSettings(_Section):
    """What is special about the topics that a name or glob matches."""

    rename: Text | None = Field(default=None, examples=["/sensors/imu"])
    """The topic's name in the sequence; only for a single topic, not for a glob."""
    metadata: dict[Text, JsonValue] = Field(default={}, examples=[{"mount": "roof"}])
    """What to know about the topic."""
    every: Annotated[int, Field(ge=1)] = Field(default=1, examples=[3])
    """Keep one message in so many."""
    image: Literal["raw", "png"] = "raw"
    """How the pixels of raw images are stored: as recorded, or as PNG."""


class AdaptersSection(_Section):
    """How messages become ontology records where the built-in adapters are not wanted."""

    load: tuple[Text, ...] = Field(
        default=(), examples=[["adapters/battery_pack.yaml", "my_pkg.adapters:WheelAdapter"]]
    )
    """Adapters that serve every topic of their types: YAML files, `module:Class` or `file.py:Class`."""
    override: dict[Text, Text] = Field(default={}, examples=[{"/lidar/*": "LidarAdapter"}])
    """The adapter for a topic name or glob: one of the above, or the name of a built-in one. A topic's own name counts before
    globs, the first glob before later ones."""
    unmodeled: Unmodeled = Unmodeled.KEEP
    """What to do with a type that no adapter takes: keep its ROS shape, skip its topics, fail."""
    serialization_formats: dict[Text, Literal["default", "ragged", "image"]] = Field(
        default={}, examples=[{"acme_msgs/msg/Scan": "ragged"}]
    )
    """How the platform lays out a message type that no adapter takes, by type."""


class OnErrorSection(_Section):
    """What an error costs."""

    session: SessionLevelErrorPolicy = SessionLevelErrorPolicy.Report
    """After an error that ends the run: report (keep what was accepted, note the error) or delete the session."""
    topic: TopicPolicies = Field(
        default=TopicLevelErrorPolicy.Raise, examples=["raise", {"default": "raise", "/gps/*": "ignore"}]
    )
    """After an error in a topic: raise (end the run), ignore (reject the message), finalize (close the topic); one word,
    or one for each name or glob, own names before globs, the first glob before later ones, `default` for the rest."""
    message: LoaderErrorPolicy = LoaderErrorPolicy.LOG_WARN
    """For a message whose bytes do not fit its type: ignore (count it), log_warn (and say so), raise (end the run)."""


class QuarantineSection(_Section):
    """Where rejected messages are kept for `ingest replay`; while there is room, `on_error` does not come into play."""

    path: Text = Field(default="quarantine", examples=["quarantine"])
    """The folder for their bytes (MCAP) and what was wrong with them (JSONL)."""
    max: LimitText | None = Field(default=None, examples=[100, "0.1%"])
    """How many messages of one topic are kept, as a number or a share of the topic's; the next one is `on_error.topic`'s
    affair. Without it, all of them."""
    max_run: LimitText | None = Field(default=None, examples=[1000, "0.01%"])
    """How many of all topics together."""
    systematic: Annotated[int, Field(ge=1)] = 100
    """So many failures from the very start of a topic, without a good message, end it: that is no bad message but a wrong
    definition or mapping."""


class TargetSection(_Section):
    """Where sequences go: a store of files, or a Mosaico server; without both, the store `./mosaico`."""

    store: Text | None = Field(default=None, examples=["./mosaico"])
    """The directory of the embedded store, or a URL (`s3://bucket/prefix`, `gs://bucket/prefix`)."""
    host: Text | None = Field(default=None, examples=["mosaico.example.org"])
    """The server's name or address."""
    port: Annotated[int, Field(ge=1, le=65535)] = 6726
    """The server's port."""
    api_key: SecretStr | None = Field(
        default=None, examples=["${MOSAICO_API_KEY:?a key with write permission}"]
    )
    """A key with write permission; take it from the environment."""
    tls_cert: Text | None = Field(default=None, examples=["certs/ca.pem"])
    """The certificate to trust; naming one turns TLS on."""
    tls: bool = False
    """Whether the connection is encrypted; certificates are those the system trusts, unless one is named."""
    message_size: SizeText = Field(default="10MB", examples=["4MB"])
    """The size up to which rows are combined into one upload message; a larger row is a message of its own."""
    type: Text | None = Field(default=None, examples=["lake"])
    """The name of a destination that an installed package provides, instead of `store` and `host`."""
    options: dict[Text, JsonValue] = Field(default={}, examples=[{"bucket": "recordings"}])
    """The options of this destination; the package that provides it defines them."""

    @model_validator(mode="after")
    def _one_place(self) -> TargetSection:
        if self.type is not None and (self.store is not None or self.host is not None):
            other = "store" if self.host is None else "host"
            raise PydanticCustomError(
                "conflicting-keys", "{other} and type are two targets", {"key": "type", "other": other}
            )
        if self.options and self.type is None:
            raise PydanticCustomError(
                "conflicting-keys", "options are given, but no type", {"key": "options"}
            )
        if self.store is not None and self.host is not None:
            raise PydanticCustomError("conflicting-keys", "store and host are two targets", {"key": "host"})
        alone = sorted(self.model_fields_set - {"store", "host", "type", "options"})
        if self.host is None and alone:
            raise PydanticCustomError(
                "conflicting-keys",
                "{key} says how to reach a server, and no host is named",
                {"key": alone[0]},
            )
        return self


class RunSection(_Section):
    """How the job is run; nothing here changes what is stored."""

    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"] = "INFO"
    """How much is said on the terminal."""
    report: Text | None = Field(default=None, examples=["report.json"])
    """The file the run's report is written to."""
    memory: SizeText | None = Field(default=None, examples=["512MiB"])
    """How much memory batches may take, all `jobs` together; 256 MiB if not said."""
    jobs: Annotated[int, Field(ge=1, le=1024)] = 1
    """How many recordings are ingested at the same time."""


class Manifest(_Section):
    """A job: a recording, what it becomes, and where it goes."""

    version: Annotated[int, Field(ge=1, le=VERSION)] = VERSION
    """The version of this language."""
    extends: Paths | None = Field(default=None, examples=["base.yaml", ["fleet.yaml", "night.yaml"]])
    """Manifests, or parts of them, that say what this one does not; mappings are joined, later files count more."""
    defaults: dict[Name, Cell] = Field(default={}, examples=[{"VEHICLE": "demo-01"}])
    """What `${NAME}` stands for where neither the matrix nor the environment says."""
    matrix: Matrix | None = Field(
        default=None,
        examples=[{"vehicle": ["a", "b"], "day": ["monday", "tuesday"]}, [{"vehicle": "a", "day": "monday"}]],
    )
    """One job for each combination, `${NAME}` standing for its value; or the combinations, one by one."""
    bag: BagSection
    """The recording, and what it takes to read it."""
    sequence: SequenceSection = SequenceSection()
    """What the recording becomes."""
    topics: tuple[Text, ...] = Field(default=(), examples=[["/cam*", "!/cam/debug*"]])
    """Globs in order, the last that matches decides, `!` leaves out, `*` stands for `/` too; without any, every topic."""
    topic_settings: dict[Text, TopicSettings] = Field(default={}, examples=[{"/camera/*": {"every": 3}}])
    """What is special about a topic name or glob. Each setting is that of the topic's own name, else of the first glob that has it."""
    adapters: AdaptersSection = AdaptersSection()
    """How messages become ontology records where the built-in adapters are not wanted."""
    on_error: OnErrorSection = OnErrorSection()
    """What an error costs."""
    on_schema_change: OnSchemaChange | None = None
    """When a topic's message definition is not what it was in earlier sequences of the family: fail, evolve (say so, and
    store the new columns), new_topic (store it under a name of its own). Nobody looks without this."""
    quarantine: QuarantineSection | None = None
    """Where rejected messages are kept; without this section they are only counted."""
    target: TargetSection = TargetSection()
    """Where sequences go."""
    run: RunSection = RunSection()
    """How the job is run."""
