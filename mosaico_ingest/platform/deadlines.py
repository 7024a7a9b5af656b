"""This file makes a call with a deadline, on a thread of its own, so that Ctrl-C is heard: Flight itself does neither."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from typing import TypeVar

__all__ = ["DeadlinePassed", "in_thread", "within"]

_Result = TypeVar("_Result")

DeadlinePassed = FutureTimeout
"""The call has not ended in time; its thread goes on, since nothing can end it but the server."""


def within(seconds: float, call: Callable[[], _Result]) -> _Result:
    """Return what the call returns, or raise what it raises.

    Raises:
        DeadlinePassed: It takes longer.
    """
    return in_thread(call).result(seconds)


def in_thread(call: Callable[[], _Result]) -> Future[_Result]:
    """Run the call on a thread that does not keep the process."""
    outcome: Future[_Result] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as error:  # noqa: BLE001 - a thread's border: raised again where the result is asked for
            outcome.set_exception(error)

    threading.Thread(target=work, name="mosaico-ingest-call", daemon=True).start()
    return outcome
