"""This file asks every call for its API key, before anything else, and remembers what the key may do."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow.flight as fl

from mosaico_ingest.store.server.keyring import Keyring
from mosaico_ingest.store.server.refusals import Refusal
from mosaico_ingest.wire.actions import API_KEY_HEADER, Permission
from mosaico_ingest.wire.conditions import Condition, as_flight_error

__all__ = ["MIDDLEWARE", "KeyCheck", "require"]

MIDDLEWARE = "api-key"


class _Granted(fl.ServerMiddleware):
    """What the caller may do."""

    def __init__(self, permission: Permission) -> None:
        super().__init__()
        self.permission = permission


class KeyCheck(fl.ServerMiddlewareFactory):
    """Lets calls in whose key is on the ring; without a ring, all of them with every permission."""

    def __init__(self, keyring: Keyring | None) -> None:
        super().__init__()
        self._keyring = keyring

    def start_call(  # pyright: ignore[reportIncompatibleMethodOverride] - a list may hold both kinds of text
        self,
        info: fl.CallInfo,  # noqa: ARG002 - Flight gives it
        headers: Mapping[str, list[str | bytes]],
    ) -> _Granted:
        """Return what the key in the headers may do, or refuse the call."""
        if self._keyring is None:
            return _Granted(Permission.MANAGE)
        given = headers.get(API_KEY_HEADER)
        if not given:
            raise as_flight_error(Condition.UNAUTHENTICATED, "this server needs an API key")
        key = given[0].decode("ascii", "replace") if isinstance(given[0], bytes) else given[0]
        try:
            return _Granted(self._keyring.permission_of(key))
        except PermissionError as err:
            raise as_flight_error(Condition.UNAUTHENTICATED, str(err)) from err


def require(context: fl.ServerCallContext, needed: Permission) -> None:
    """Refuse the call unless its key includes `needed`."""
    granted = context.get_middleware(MIDDLEWARE)
    if not isinstance(granted, _Granted):
        raise Refusal(Condition.UNAUTHENTICATED, "this server needs an API key")
    if not granted.permission.includes(needed):
        raise Refusal(
            Condition.PERMISSION,
            f"permission denied: this needs a key with {needed.value}, this one has {granted.permission.value}",
        )
