"""This file is the border of a call: what goes wrong behind it leaves as one of the platform's statuses."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import contextmanager

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest.destinations.store.errors import NotInStore
from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import Malformed

__all__ = ["Refusal", "answered", "checked"]

_LOG = logging.getLogger(__name__)


class Refusal(Exception):  # noqa: N818 - a status, which need not be anybody's error
    """The call is refused with one of the platform's statuses."""

    def __init__(self, condition: Condition, text: str) -> None:
        super().__init__(text)
        self.condition = condition


@contextmanager
def checked() -> Generator[None, None, None]:
    """Refuse the call as invalid where a rule for names, metadata or columns is broken inside."""
    try:
        yield
    except (SinkError, pa.ArrowException) as err:
        raise Refusal(Condition.INVALID, str(err)) from err


@contextmanager
def answered() -> Generator[None, None, None]:
    """Turn whatever is raised inside into what Flight carries to the client."""
    try:
        yield
    except fl.FlightError:
        raise
    except Exception as err:  # noqa: BLE001 - the border to clients
        # Arrow sends the traceback along: what the cause says, of other sequences too, is not for them.
        raise as_flight_error(*_condition_of(err)) from None


def _condition_of(err: Exception) -> tuple[Condition, str]:
    if isinstance(err, Refusal):
        return err.condition, str(err)
    if isinstance(err, NotInStore):
        return Condition.NOT_FOUND, f"not found: {err.what}"
    if isinstance(err, SequenceExists):
        return Condition.EXISTS, f"{err.where} already exists"
    known = {
        Malformed: Condition.INVALID,
        SinkUnavailable: Condition.UNAVAILABLE,
        SinkError: Condition.INTERNAL,
    }
    for kind, condition in known.items():
        if isinstance(err, kind):
            return condition, str(err)
    _LOG.exception("a call failed")
    return Condition.INTERNAL, f"unexpected {type(err).__name__}"
