"""This file is the calls a server answers: their names, bodies, and the permission each needs."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from mosaico_ingest.frozen import frozen
from mosaico_ingest.wire import bodies
from mosaico_ingest.wire.bodies import Body

__all__ = [
    "ACTIONS",
    "API_KEY_HEADER",
    "INFO",
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
    "TOPIC_NOTIFICATION_CREATE",
    "TOPIC_NOTIFICATION_LIST",
    "TOPIC_NOTIFICATION_PURGE",
    "VERSION",
    "Action",
    "Permission",
]

API_KEY_HEADER = "mosaico-api-key-token"
"""The call header that carries the API key."""

Question = TypeVar("Question", bound=Body)
Answer = TypeVar("Answer", bound=Body)


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


@frozen
class Action(Generic[Question, Answer]):
    """A call: what is asked, what is answered (`Empty`: nothing)."""

    name: str
    question: type[Question]
    answer: type[Answer]
    permission: Permission
    repeatable: bool = False
    """Whether asking again after a lost answer does no harm."""


_READ, _WRITE, _DELETE = Permission.READ, Permission.WRITE, Permission.DELETE

INFO = Action("info", bodies.Empty, bodies.Info, _READ, repeatable=True)
VERSION = Action("version", bodies.Empty, bodies.Version, _READ, repeatable=True)
QUERY = Action("query", bodies.Query, bodies.QueryResult, _READ, repeatable=True)
SEQUENCE_CREATE = Action("sequence_create", bodies.SequenceCreate, bodies.Empty, _WRITE)
SEQUENCE_DELETE = Action("sequence_delete", bodies.Located, bodies.Empty, _DELETE, repeatable=True)
SESSION_CREATE = Action("session_create", bodies.Located, bodies.SessionCreated, _WRITE)
SESSION_FINALIZE = Action("session_finalize", bodies.SessionFinalize, bodies.Empty, _WRITE)
SESSION_DELETE = Action("session_delete", bodies.Located, bodies.Empty, _DELETE, repeatable=True)
TOPIC_CREATE = Action("topic_create", bodies.TopicCreate, bodies.TopicCreated, _WRITE)
TOPIC_DELETE = Action("topic_delete", bodies.Located, bodies.Empty, _DELETE, repeatable=True)
SEQUENCE_NOTIFICATION_CREATE = Action(
    "sequence_notification_create", bodies.NotificationCreate, bodies.Empty, _WRITE
)
SEQUENCE_NOTIFICATION_LIST = Action(
    "sequence_notification_list", bodies.Located, bodies.Notifications, _READ, repeatable=True
)
SEQUENCE_NOTIFICATION_PURGE = Action(
    "sequence_notification_purge", bodies.Located, bodies.Empty, _DELETE, repeatable=True
)
TOPIC_NOTIFICATION_CREATE = Action(
    "topic_notification_create", bodies.NotificationCreate, bodies.Empty, _WRITE
)
TOPIC_NOTIFICATION_LIST = Action(
    "topic_notification_list", bodies.Located, bodies.Notifications, _READ, repeatable=True
)
TOPIC_NOTIFICATION_PURGE = Action(
    "topic_notification_purge", bodies.Located, bodies.Empty, _DELETE, repeatable=True
)

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
        )
    }
)
"""Every call by name."""
