"""Messages of the Mosaico protocol: bodies, actions, permissions and their encoding."""

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

from mosaico_ingest.ontology.types import SerializationFormat

__all__ = [
    "ACTIONS",
    "API_KEY_CREATE",
    "API_KEY_HEADER",
    "API_KEY_LIST",
    "API_KEY_REVOKE",
    "API_KEY_STATUS",
    "DEFAULT_LIMIT_BYTES",
    "INFO",
    "JSON",
    "QUERY",
    "SEQUENCE_CREATE",
    "SEQUENCE_DELETE",
    "SEQUENCE_NOTIFICATION_CREATE",
    "SEQUENCE_NOTIFICATION_LIST",
    "SEQUENCE_NOTIFICATION_PURGE",
    "SESSION_CREATE",
    "SESSION_DELETE",
    "SESSION_FINALIZE",
    "TOPIC_CREATE",
    "TOPIC_DELETE",
    "TOPIC_FILTER_CLUSTERIZE",
    "TOPIC_FILTER_INTERSECT",
    "TOPIC_NOTIFICATION_CREATE",
    "TOPIC_NOTIFICATION_LIST",
    "TOPIC_NOTIFICATION_PURGE",
    "VERSION",
    "Action",
    "Body",
    "Cluster",
    "Clusterize",
    "Codec",
    "DataInfo",
    "Empty",
    "GetInfo",
    "Info",
    "Intersect",
    "Interval",
    "KeyCreate",
    "KeyCreated",
    "KeyFingerprint",
    "KeyList",
    "KeyStatus",
    "Limits",
    "Located",
    "Malformed",
    "Notification",
    "NotificationCreate",
    "Notifications",
    "Permission",
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
    "TimeBounds",
    "TimeWindow",
    "TopicCreate",
    "TopicCreated",
    "TopicInfo",
    "Version",
    "session_locator",
    "topic_locator",
    "topic_name",
]

DEFAULT_LIMIT_BYTES = 50_000_000
"""The message limit of a server that does not announce one, in bytes."""


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


class Permission(str, Enum):
    """What a key may do; each includes the ones before it."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    MANAGE = "manage"
    # The platform's own spelling, as in `APIKeyPermissionEnum.Write`; aliases are no members of their own.
    Read = READ
    Write = WRITE
    Delete = DELETE
    Manage = MANAGE

    def includes(self, needed: Permission) -> bool:
        """Return whether a key with this permission may do what needs `needed`."""
        order = list(Permission)
        return order.index(self) >= order.index(needed)


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

    grpc_max_decode_message_size: int = DEFAULT_LIMIT_BYTES
    grpc_max_encode_message_size: int = DEFAULT_LIMIT_BYTES
    grpc_target_encode_message_size: int = DEFAULT_LIMIT_BYTES // 2


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


class TimeBounds(Body):
    """The first and the last time stamp of a range, both inclusive."""

    start_ns: int
    end_ns: int


class Clusterize(Body):
    """The rows of a topic that match conditions, grouped by time."""

    locator: str
    clustering_dt_ns: int = Field(default=0, ge=0)
    """Gaps of at least this length separate clusters; 0 returns one cluster."""
    ontology: dict[str, Any] = Field(default_factory=dict[str, Any])
    timestamp_range: TimeBounds | None = None


class Intersect(Body):
    """The times at which every topic has a cluster."""

    topics: list[Clusterize] = Field(min_length=1)
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


_Body = TypeVar("_Body", bound=Body)


class Malformed(ValueError):  # noqa: N818 - the condition, as in `errors`
    """Bytes that are not the body they should be; says what is wrong in one line."""


class Codec(Protocol):
    """How bodies travel."""

    def encode(self, body: Body) -> bytes:
        """Return the bytes of a question, a descriptor or application metadata."""
        ...

    def decode(self, kind: type[_Body], data: bytes) -> _Body:
        """Return the body.

        Raises:
            Malformed: The bytes are no `kind`.
        """
        ...

    def encode_answer(self, action: Action[Any, Any], answer: Body) -> bytes:
        """Return the bytes of an action's result."""
        ...

    def decode_answer(self, action: Action[Any, _Body], data: bytes) -> _Body:
        """Return what an action's results say, joined.

        Raises:
            Malformed: The bytes are no answer to `action`.
        """
        ...


class _Envelope(BaseModel):
    """What JSON answers are wrapped in; an action without an answer may call itself `empty`."""

    model_config = ConfigDict(frozen=True)

    action: str = "empty"
    response: dict[str, Any] | None = None


class _Json:
    """Bodies as UTF-8 JSON, answers with the name of their action."""

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
            raise Malformed(f"an answer to {envelope.action!r} instead of {action.name!r}")
        try:
            return action.answer.model_validate(envelope.response or {})
        except ValidationError as error:
            raise Malformed(_first(error)) from error


JSON: Codec = _Json()
"""What servers up to 0.7 speak."""

_Model = TypeVar("_Model", bound=BaseModel)


def _validate(kind: type[_Model], data: bytes) -> _Model:
    try:
        return kind.model_validate_json(data)
    except ValidationError as error:
        raise Malformed(_first(error)) from error


def _first(error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    field = ".".join(map(str, first["loc"]))
    return f"{field}: {first['msg']}" if field else first["msg"]


API_KEY_HEADER = "mosaico-api-key-token"
"""The call header that carries the API key."""

Question = TypeVar("Question", bound=Body)
Answer = TypeVar("Answer", bound=Body)


class Action(Struct, Generic[Question, Answer], frozen=True):
    """A call: what is asked, what is answered (`Empty`: nothing)."""

    name: str
    question: type[Question]
    answer: type[Answer]
    permission: Permission
    repeatable: bool = False
    """Whether a repetition after a lost response has no side effect."""
    streamed: bool = False
    """Whether the response is a sequence of bodies, each in a result of its own."""


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
"""Every call by name."""
