"""Errors of a call, and their translation to statuses of the protocol."""

from __future__ import annotations

import logging
import time
from collections.abc import Generator
from contextlib import contextmanager

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest.destinations.store.files import NotInStore
from mosaico_ingest.errors import SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.protocol.errors import Condition, as_flight_error
from mosaico_ingest.protocol.messages import Malformed

_LOG = logging.getLogger(__name__)


class Refusal(Exception):  # noqa: N818 - named after the status that it carries
    """The refusal of a call with a status of the protocol."""

    def __init__(self, condition: Condition, text: str) -> None:
        super().__init__(text)
        self.condition = condition


class Deadline:
    """The time limit of one call, which long calls check between their steps."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._end_s = time.monotonic() + seconds

    def check(self) -> None:
        """Refuse the call if its time limit has passed."""
        if time.monotonic() > self._end_s:
            raise Refusal(Condition.TIMED_OUT, f"the request exceeded its time limit of {self._seconds:g} s")


@contextmanager
def refuse_invalid() -> Generator[None, None, None]:
    """Refuse the call as invalid if a check of names, metadata or columns fails in the block."""
    try:
        yield
    except (SinkError, pa.ArrowException) as err:
        raise Refusal(Condition.INVALID, str(err)) from err


@contextmanager
def translate_errors() -> Generator[None, None, None]:
    """Raise every error of the block as the exception that Flight sends to the client.

    Only exceptions of Flight may leave a call. Arrow sends the traceback of other exceptions, which contains paths, to
    the client, and never frees them.
    """
    try:
        yield
    except fl.FlightError:
        raise
    except Exception as err:  # noqa: BLE001 - no other exception may reach Flight
        raise as_flight_error(*_condition_of(err)) from None


def _condition_of(err: Exception) -> tuple[Condition, str]:
    if isinstance(err, Refusal):
        return err.condition, str(err)
    if isinstance(err, NotInStore):
        return Condition.NOT_FOUND, f"not found: {err.what}"
    if isinstance(err, SequenceExists):
        return Condition.EXISTS, f"{err.where} already exists"
    conditions = {
        Malformed: Condition.INVALID,
        SinkUnavailable: Condition.UNAVAILABLE,
        SinkError: Condition.INTERNAL,
    }
    for kind, condition in conditions.items():
        if isinstance(err, kind):
            return condition, str(err)
    _LOG.exception("a call failed")
    return Condition.INTERNAL, f"unexpected {type(err).__name__}"
