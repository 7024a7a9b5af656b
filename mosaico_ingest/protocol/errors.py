"""The statuses of the protocol, and their mapping to and from exceptions of Flight.

Flight for Python has no exception for some statuses. Messages of these statuses start with the name of the status.
"""

from __future__ import annotations

from enum import Enum

import pyarrow as pa
import pyarrow.flight as fl


class Condition(str, Enum):
    """The statuses of the protocol."""

    EXISTS = "ALREADY_EXISTS"
    NOT_FOUND = "NOT_FOUND"
    INVALID = "INVALID_ARGUMENT"
    UNAUTHENTICATED = "UNAUTHENTICATED"
    PERMISSION = "PERMISSION_DENIED"
    PRECONDITION = "FAILED_PRECONDITION"
    UNAVAILABLE = "UNAVAILABLE"
    TIMED_OUT = "DEADLINE_EXCEEDED"
    CANCELLED = "CANCELLED"
    TOO_LARGE = "OUT_OF_RANGE"
    UNIMPLEMENTED = "UNIMPLEMENTED"
    INTERNAL = "INTERNAL"


_BY_TYPE: tuple[tuple[type[Exception], Condition], ...] = (
    (fl.FlightUnauthenticatedError, Condition.UNAUTHENTICATED),
    (fl.FlightUnauthorizedError, Condition.PERMISSION),
    (fl.FlightUnavailableError, Condition.UNAVAILABLE),
    (fl.FlightTimedOutError, Condition.TIMED_OUT),
    (fl.FlightCancelledError, Condition.CANCELLED),
    (fl.FlightInternalError, Condition.INTERNAL),
    (pa.ArrowKeyError, Condition.NOT_FOUND),
    (pa.ArrowNotImplementedError, Condition.UNIMPLEMENTED),
    (pa.ArrowInvalid, Condition.INVALID),
    (OSError, Condition.UNAVAILABLE),  # the server closed a stream without a status
)
_BY_TEXT: tuple[tuple[str, Condition], ...] = (
    ("already exist", Condition.EXISTS),
    ("already_exist", Condition.EXISTS),
    ("failed_precondition", Condition.PRECONDITION),
    ("failed precondition", Condition.PRECONDITION),
    ("out_of_range", Condition.TOO_LARGE),
    ("message length too large", Condition.TOO_LARGE),
    ("larger than max", Condition.TOO_LARGE),
    ("resource_exhausted", Condition.TOO_LARGE),
    ("unauthenticated", Condition.UNAUTHENTICATED),
    ("permission denied", Condition.PERMISSION),
    ("permission_denied", Condition.PERMISSION),
    ("socket closed", Condition.UNAVAILABLE),
    ("connection reset", Condition.UNAVAILABLE),
    ("unimplemented", Condition.UNIMPLEMENTED),
    ("unknown action", Condition.UNIMPLEMENTED),
    ("not found", Condition.NOT_FOUND),
)
_SPECIFIC = frozenset({fl.FlightUnauthenticatedError, fl.FlightUnauthorizedError, fl.FlightUnavailableError})


def condition_of(error: BaseException) -> Condition:
    """Return the status of an error, from its type or, if several statuses share the type, from its message."""
    by_type = next((condition for kind, condition in _BY_TYPE if isinstance(error, kind)), Condition.INTERNAL)
    if type(error) in _SPECIFIC:
        return by_type
    text = text_of(error).lower()
    for condition in Condition:
        if text.startswith(f"{condition.value.lower()}:"):
            return condition
    return next((condition for words, condition in _BY_TEXT if words in text), by_type)


def text_of(error: BaseException) -> str:
    """Return the server's message in one line, without the additions of Flight and gRPC."""
    text = str(error).strip().strip("'")
    for end in (". Detail: ", ". gRPC client debug context", " Client context:", "\n"):
        text = text.partition(end)[0]
    text = text.rpartition(", with message: ")[2].removeprefix("Unknown error: ")
    return text.strip() or type(error).__name__


def as_flight_error(condition: Condition, text: str) -> fl.FlightError:
    """Return the exception that a server raises so that clients see `condition`.

    The result is always an exception of Flight, because Arrow leaks other exceptions and sends their tracebacks to the client.
    """
    for kind, candidate in _BY_TYPE:
        if candidate is condition and issubclass(kind, fl.FlightError):
            return kind(text)
    return fl.FlightServerError(f"{condition.value}: {text}")
