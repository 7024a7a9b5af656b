"""This file turns bodies into bytes and back: JSON today, behind a seam for what the platform speaks next."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from mosaico_ingest.wire.actions import Action
from mosaico_ingest.wire.bodies import Body

__all__ = ["JSON", "Codec", "Malformed"]

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
    place = ".".join(map(str, first["loc"]))
    return f"{place}: {first['msg']}" if place else first["msg"]
