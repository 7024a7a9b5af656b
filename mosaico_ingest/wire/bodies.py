"""This file is what travels: the bodies of actions, descriptors and application metadata."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from mosaico_ingest.ontology.types import SerializationFormat

__all__ = [
    "DEFAULT_DECODE_BYTES",
    "Body",
    "DataInfo",
    "Empty",
    "GetInfo",
    "Info",
    "Interval",
    "Limits",
    "Located",
    "Notification",
    "NotificationCreate",
    "Notifications",
    "Put",
    "Query",
    "QueryResult",
    "QueryTopic",
    "QueryTopics",
    "SemVer",
    "SequenceCreate",
    "SequenceInfo",
    "SessionCreated",
    "SessionFinalize",
    "SessionInfo",
    "TimeWindow",
    "TopicCreate",
    "TopicCreated",
    "TopicInfo",
    "Version",
    "session_locator",
    "topic_locator",
    "topic_name",
]

DEFAULT_DECODE_BYTES = 50 << 20
"""What a server takes in one message where it does not say."""


def topic_locator(sequence: str, topic: str) -> str:
    """Return `seq/imu` of `seq` and `/imu`."""
    return f"{sequence}/{topic.removeprefix('/')}"


def topic_name(locator: str) -> str:
    """Return `/imu` of `seq/imu`."""
    return f"/{locator.partition('/')[2]}"


def session_locator(sequence: str, ulid: str) -> str:
    """Return `seq:01J…`."""
    return f"{sequence}:{ulid}"


class Body(BaseModel):
    """Anything that travels; what a newer peer adds is passed over."""

    model_config = ConfigDict(frozen=True, extra="ignore", defer_build=True)


class Empty(Body):
    """Nothing to say."""


class Located(Body):
    """One sequence, session or topic."""

    locator: str


class SemVer(Body):
    """A version in parts."""

    major: int
    minor: int
    patch: int
    pre: str | None = None


class Limits(Body):
    """What fits into one message."""

    grpc_max_decode_message_size: int = DEFAULT_DECODE_BYTES
    grpc_max_encode_message_size: int = DEFAULT_DECODE_BYTES
    grpc_target_encode_message_size: int = DEFAULT_DECODE_BYTES // 2


class Info(Body):
    """The answer to the handshake."""

    version: str
    semver: SemVer
    config: Limits


class Version(Body):
    """The answer to the handshake of a server that does not know `info`."""

    version: str = "unknown"


class SequenceCreate(Body):
    """A new sequence; its metadata is fixed from then on."""

    locator: str
    user_metadata: dict[str, Any]


class SessionCreated(Body):
    """A session that topics can be written in."""

    uuid: str
    locator: str = ""
    """`seq:01J…`; empty from servers before 0.5."""


class TopicCreate(Body):
    """A new topic of a session."""

    session_uuid: str
    locator: str
    serialization_format: SerializationFormat
    ontology_tag: str
    user_metadata: dict[str, Any]


class TopicCreated(Body):
    """A topic that can be put, once."""

    uuid: str


class SessionFinalize(Body):
    """The end of a session: its topics become visible."""

    session_uuid: str


class NotificationCreate(Body):
    """Something to know about a sequence or a topic."""

    locator: str
    notification_type: str = "error"
    msg: str


class Notification(Body):
    """Something that is known about a sequence or a topic."""

    name: str
    """The locator."""
    notification_type: str
    msg: str
    created_datetime: str
    """ISO 8601, UTC."""


class Notifications(Body):
    """All that is known about a sequence or a topic."""

    notifications: list[Notification]


class Query(Body):
    """Filters that must all hold; each is `{key: {operator: value}}`."""

    sequence: dict[str, Any] = Field(default_factory=dict[str, Any])
    topic: dict[str, Any] = Field(default_factory=dict[str, Any])
    ontology: dict[str, Any] = Field(default_factory=dict[str, Any])
    include_timestamp_range: bool = False


class _OmitsNone(Body):
    @model_serializer(mode="wrap")
    def _without_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}


class QueryTopic(_OmitsNone):
    """A topic that fits."""

    locator: str
    ontology_tag: str
    timestamp_range: tuple[int, int] | None = None
    """First and last time stamp that fit, where it was asked for."""


class QueryTopics(Body):
    """The topics of one sequence that fit."""

    sequence: str
    topics: list[QueryTopic]


class QueryResult(Body):
    """Everything that fits."""

    items: list[QueryTopics]


class Put(Body):
    """The descriptor of an upload."""

    resource_locator: str
    topic_uuid: str


class GetInfo(_OmitsNone):
    """The descriptor of a question about a sequence or a topic; the start is in, the end is out."""

    resource_locator: str
    timestamp_ns_start: int | None = None
    timestamp_ns_end: int | None = None


class SessionInfo(Body):
    """A session as a sequence's application metadata tells it; older servers say less."""

    locator: str = ""
    created_at_ns: int = 0
    locked: bool = False
    """Whether it is finalized."""
    completed_at_ns: int | None = None
    topics: list[str] = Field(default_factory=list[str])
    """Their locators."""


class SequenceInfo(Body):
    """A sequence's application metadata; older servers say less."""

    resource_locator: str = ""
    created_at_ns: int = 0
    user_metadata: dict[str, Any] = Field(default_factory=dict[str, Any])
    sessions: list[SessionInfo] = Field(default_factory=list[SessionInfo])


class Interval(Body):
    """The first and the last time stamp, both of them in."""

    start_ns: int
    end_ns: int


class DataInfo(Body):
    """How much a topic holds."""

    interval: Interval | None = None
    """null of an empty topic."""
    total_row_count: int
    total_bytes: int
    total_chunks_count: int


class TimeWindow(Body):
    """How much of a topic lies in the range that was asked for."""

    interval: Interval | None = None
    row_count: int


class TopicInfo(Body):
    """A topic's application metadata, on its endpoint."""

    resource_locator: str
    ontology_tag: str
    serialization_format: SerializationFormat
    user_metadata: dict[str, Any]
    created_at_ns: int
    completed_at_ns: int | None = None
    locked: bool
    data_info: DataInfo
    time_window_info: TimeWindow | None = None
