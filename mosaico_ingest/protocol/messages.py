"""Messages of the Mosaico protocol: bodies, actions and permissions, and their encoding."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar

from msgspec import Struct
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from mosaico_ingest.ontology.registry import SerializationFormat

DEFAULT_LIMIT_BYTES = 50_000_000
"""The message limit of a server that does not announce one, in bytes."""


def topic_locator(sequence: str, topic: str) -> str:
    """Return the locator of a topic: `seq/imu` for `seq` and `/imu`."""
    return f"{sequence}/{topic.removeprefix('/')}"


def topic_name(locator: str) -> str:
    """Return the topic of a locator: `/imu` for `seq/imu`."""
    return f"/{locator.partition('/')[2]}"


def session_locator(sequence: str, ulid: str) -> str:
    """Return the locator of a session: `seq:01J…`."""
    return f"{sequence}:{ulid}"


class Body(BaseModel):
    """A message body; unknown fields from newer peers are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", defer_build=True)


class Permission(str, Enum):
    """The permission of an API key; each permission includes the previous ones."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    MANAGE = "manage"
    # Aliases with the platform's spelling, as in `APIKeyPermissionEnum.Write`.
    Read = READ
    Write = WRITE
    Delete = DELETE
    Manage = MANAGE

    def includes(self, needed: Permission) -> bool:
        """Return whether this permission includes `needed`."""
        order = list(Permission)
        return order.index(self) >= order.index(needed)


class Empty(Body):
    """An empty body."""


class Located(Body):
    """The locator of a sequence, session or topic."""

    locator: str


class SemVer(Body):
    """A semantic version."""

    major: int
    minor: int
    patch: int
    pre: str | None = None


class Limits(Body):
    """The limits of one message, in bytes."""

    grpc_max_decode_message_size: int = DEFAULT_LIMIT_BYTES
    grpc_max_encode_message_size: int = DEFAULT_LIMIT_BYTES
    grpc_target_encode_message_size: int = DEFAULT_LIMIT_BYTES // 2


class Info(Body):
    """The response to the handshake."""

    version: str
    semver: SemVer
    config: Limits


class Version(Body):
    """The response to the handshake of servers that do not support `info`."""

    version: str = "unknown"


class SequenceCreate(Body):
    """A new sequence, whose metadata cannot be changed later."""

    locator: str
    user_metadata: dict[str, Any]


class SessionCreated(Body):
    """A new session, which accepts topics."""

    uuid: str
    locator: str = ""
    """`seq:01J…`; empty in responses of servers before 0.5."""


class TopicCreate(Body):
    """A new topic of a session."""

    session_uuid: str
    locator: str
    serialization_format: SerializationFormat
    ontology_tag: str
    user_metadata: dict[str, Any]


class TopicCreated(Body):
    """A new topic, which accepts one upload."""

    uuid: str


class SessionFinalize(Body):
    """The commit of a session, which makes its topics visible."""

    session_uuid: str


class NotificationCreate(Body):
    """A new notification about a sequence or a topic."""

    locator: str
    notification_type: str = "error"
    msg: str


class Notification(Body):
    """A notification about a sequence or a topic."""

    name: str
    """The locator of the sequence or topic."""
    notification_type: str
    msg: str
    created_datetime: str
    """The time of creation in ISO 8601, UTC."""


class Notifications(Body):
    """All notifications about a sequence or a topic."""

    notifications: list[Notification]


class Query(Body):
    """The filters of a query, all of which must match; each is `{key: {operator: value}}`."""

    sequence: dict[str, Any] = Field(default_factory=dict[str, Any])
    topic: dict[str, Any] = Field(default_factory=dict[str, Any])
    ontology: dict[str, Any] = Field(default_factory=dict[str, Any])
    include_timestamp_range: bool = False


class _OmitsNone(Body):
    @model_serializer(mode="wrap")
    def _without_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value is not None}


class QueryTopic(_OmitsNone):
    """A topic that matches a query."""

    locator: str
    ontology_tag: str
    timestamp_range: tuple[int, int] | None = None
    """First and last timestamp of the matching rows, in nanoseconds; None unless the query requests it."""


class QueryTopics(Body):
    """A sequence that matches a query, with its matching topics."""

    sequence: str
    topics: list[QueryTopic]


class QueryResult(Body):
    """The sequences and topics that match a query."""

    items: list[QueryTopics]


class TimeBounds(Body):
    """A time range. The end of a cluster is its last timestamp; the end of a condition is excluded."""

    start_ns: int
    end_ns: int


class Clusterize(Body):
    """The rows of a topic that match conditions, grouped by time."""

    locator: str
    clustering_dt_ns: int = Field(default=0, ge=0)
    """Gaps longer than this separate clusters; 0 returns one cluster."""
    ontology: dict[str, Any] = Field(default_factory=dict[str, Any])
    """Conditions, at least one."""
    timestamp_range: TimeBounds | None = None


class Intersect(Body):
    """The times at which every topic has a cluster."""

    topics: list[Clusterize] = Field(min_length=2)
    """Topics of one sequence."""
    intersect_dt_ns: int = Field(default=0, ge=0)
    """Clusters at most this far apart count as overlapping."""


class Cluster(Body):
    """A range of time, with its number in the response."""

    ts: TimeBounds
    id: int


class KeyCreate(Body):
    """A new API key."""

    permissions: Permission
    description: str = ""
    expires_at_ns: int | None = None


class KeyCreated(Body):
    """The new API key, which cannot be recovered later."""

    api_key_token: str


class KeyFingerprint(Body):
    """The fingerprint of an API key."""

    api_key_fingerprint: str


class KeyStatus(_OmitsNone):
    """The properties of an API key."""

    api_key_fingerprint: str
    created_at_ns: int
    expires_at_ns: int | None = None
    description: str | None = None
    permissions: Permission


class KeyList(Body):
    """The properties of every API key."""

    api_keys: list[KeyStatus]


class Put(Body):
    """The descriptor of an upload."""

    resource_locator: str
    topic_uuid: str


class GetInfo(_OmitsNone):
    """The descriptor of a request for a sequence or a topic; the start is inclusive, the end exclusive."""

    resource_locator: str
    timestamp_ns_start: int | None = None
    timestamp_ns_end: int | None = None


class SessionInfo(Body):
    """A session in the application metadata of a sequence; older servers omit fields."""

    locator: str = ""
    created_at_ns: int = 0
    locked: bool = False
    """Whether the session is finalized."""
    completed_at_ns: int | None = None
    topics: list[str] = Field(default_factory=list[str])
    """The locators of the topics."""


class SequenceInfo(Body):
    """The application metadata of a sequence; older servers omit fields."""

    resource_locator: str = ""
    created_at_ns: int = 0
    user_metadata: dict[str, Any] = Field(default_factory=dict[str, Any])
    sessions: list[SessionInfo] = Field(default_factory=list[SessionInfo])


class Interval(Body):
    """The first and the last timestamp of a topic, both inclusive."""

    start_ns: int
    end_ns: int


class DataInfo(Body):
    """The size and the time interval of a topic."""

    interval: Interval | None = None
    """None if the topic is empty."""
    total_row_count: int
    total_bytes: int
    total_chunks_count: int


class TimeWindow(Body):
    """The part of a topic that lies in the requested time range."""

    interval: Interval | None = None
    row_count: int


class TopicInfo(Body):
    """The application metadata of a topic, on its endpoint."""

    resource_locator: str
    ontology_tag: str
    serialization_format: SerializationFormat
    user_metadata: dict[str, Any]
    created_at_ns: int
    completed_at_ns: int | None = None
    locked: bool
    data_info: DataInfo | None
    """None from servers before 0.7."""
    time_window_info: TimeWindow | None = None


_Body = TypeVar("_Body", bound=Body)


class Malformed(ValueError):  # noqa: N818 - named after the condition
    """Bytes that are not the expected body; the text is the reason in one line."""


class Codec(Protocol):
    """The encoding of message bodies."""

    def encode(self, body: Body) -> bytes:
        """Return the encoded request, descriptor or application metadata."""
        ...

    def decode(self, kind: type[_Body], data: bytes) -> _Body:
        """Return the decoded body.

        Raises:
            Malformed: The bytes are not a valid `kind`.
        """
        ...

    def encode_answer(self, action: Action[Any, Any], answer: Body) -> bytes:
        """Return the encoded response to an action."""
        ...

    def decode_answer(self, action: Action[Any, _Body], data: bytes) -> _Body:
        """Return the decoded response to an action, from the joined results of the call.

        Raises:
            Malformed: The bytes are not a valid response to `action`.
        """
        ...


class _Envelope(BaseModel):
    """The envelope of JSON responses; the action may be `empty` if the response has no fields."""

    model_config = ConfigDict(frozen=True)

    action: str = "empty"
    response: dict[str, Any] | None = None


class _Json:
    """The codec for UTF-8 JSON, with responses in an `_Envelope`."""

    def encode(self, body: Body) -> bytes:
        return body.model_dump_json().encode()

    def decode(self, kind: type[_Body], data: bytes) -> _Body:
        return _validate(kind, data)

    def encode_answer(self, action: Action[Any, Any], answer: Body) -> bytes:
        response = answer.model_dump(mode="json") or None
        return _Envelope(action=action.name, response=response).model_dump_json().encode()

    def decode_answer(self, action: Action[Any, _Body], data: bytes) -> _Body:
        envelope = _validate(_Envelope, data or b"{}")
        if envelope.action not in {action.name, "empty"}:
            raise Malformed(f"the response is for {envelope.action!r} instead of {action.name!r}")
        try:
            return action.answer.model_validate(envelope.response or {})
        except ValidationError as error:
            raise Malformed(_first_problem(error)) from error


JSON: Codec = _Json()
"""The encoding of servers up to version 0.7."""

_Model = TypeVar("_Model", bound=BaseModel)


def _validate(kind: type[_Model], data: bytes) -> _Model:
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise Malformed(_first_problem(error)) from error


def _first_problem(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    field = ".".join(map(str, first["loc"]))
    return f"{field}: {first['msg']}" if field else first["msg"]


API_KEY_HEADER = "mosaico-api-key-token"
"""The call header that carries the API key."""

Question = TypeVar("Question", bound=Body)
Answer = TypeVar("Answer", bound=Body)


class Action(Struct, Generic[Question, Answer], frozen=True):
    """An action of the protocol, with the types of its request and its response."""

    name: str
    question: type[Question]
    answer: type[Answer]
    permission: Permission
    repeatable: bool = False
    """Whether a repetition after a lost response has no side effect."""
    streamed: bool = False
    """Whether the response is a sequence of bodies, each in its own result."""


_READ, _WRITE, _DELETE, _MANAGE = Permission

INFO = Action("info", Empty, Info, _READ, repeatable=True)
VERSION = Action("version", Empty, Version, _READ, repeatable=True)
QUERY = Action("query", Query, QueryResult, _READ, repeatable=True)
SEQUENCE_CREATE = Action("sequence_create", SequenceCreate, Empty, _WRITE)
SEQUENCE_DELETE = Action("sequence_delete", Located, Empty, _DELETE, repeatable=True)
SESSION_CREATE = Action("session_create", Located, SessionCreated, _WRITE)
SESSION_FINALIZE = Action("session_finalize", SessionFinalize, Empty, _WRITE)
SESSION_DELETE = Action("session_delete", Located, Empty, _DELETE, repeatable=True)
TOPIC_CREATE = Action("topic_create", TopicCreate, TopicCreated, _WRITE)
TOPIC_DELETE = Action("topic_delete", Located, Empty, _DELETE, repeatable=True)
SEQUENCE_NOTIFICATION_CREATE = Action("sequence_notification_create", NotificationCreate, Empty, _WRITE)
SEQUENCE_NOTIFICATION_LIST = Action(
    "sequence_notification_list", Located, Notifications, _READ, repeatable=True
)
SEQUENCE_NOTIFICATION_PURGE = Action("sequence_notification_purge", Located, Empty, _DELETE, repeatable=True)
TOPIC_NOTIFICATION_CREATE = Action("topic_notification_create", NotificationCreate, Empty, _WRITE)
TOPIC_NOTIFICATION_LIST = Action("topic_notification_list", Located, Notifications, _READ, repeatable=True)
TOPIC_FILTER_CLUSTERIZE = Action(
    "topic_filter_clusterize", Clusterize, Cluster, _READ, repeatable=True, streamed=True
)
TOPIC_FILTER_INTERSECT = Action(
    "topic_filter_intersect", Intersect, Cluster, _READ, repeatable=True, streamed=True
)
API_KEY_CREATE = Action("api_key_create", KeyCreate, KeyCreated, _MANAGE)
API_KEY_STATUS = Action("api_key_status", KeyFingerprint, KeyStatus, _MANAGE, repeatable=True)
API_KEY_LIST = Action("api_key_list", Empty, KeyList, _MANAGE, repeatable=True)
API_KEY_REVOKE = Action("api_key_revoke", KeyFingerprint, Empty, _MANAGE)
TOPIC_NOTIFICATION_PURGE = Action("topic_notification_purge", Located, Empty, _DELETE, repeatable=True)

ACTIONS: Mapping[str, Action[Any, Any]] = MappingProxyType(
    {
        action.name: action
        for action in (
            INFO,
            VERSION,
            QUERY,
            SEQUENCE_CREATE,
            SEQUENCE_DELETE,
            SESSION_CREATE,
            SESSION_FINALIZE,
            SESSION_DELETE,
            TOPIC_CREATE,
            TOPIC_DELETE,
            SEQUENCE_NOTIFICATION_CREATE,
            SEQUENCE_NOTIFICATION_LIST,
            SEQUENCE_NOTIFICATION_PURGE,
            TOPIC_NOTIFICATION_CREATE,
            TOPIC_NOTIFICATION_LIST,
            TOPIC_NOTIFICATION_PURGE,
            TOPIC_FILTER_CLUSTERIZE,
            TOPIC_FILTER_INTERSECT,
            API_KEY_CREATE,
            API_KEY_STATUS,
            API_KEY_LIST,
            API_KEY_REVOKE,
        )
    }
)
"""Every action by name."""
