"""Settings of the process: signals, garbage collection, memory, and the import of pandas."""

from __future__ import annotations

import ctypes
import gc
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.machinery import ModuleSpec
from types import FrameType
from typing import TYPE_CHECKING

from mosaico_ingest.errors import AdapterError

if TYPE_CHECKING:
    from mosaico_ingest.job.config import ROSInjectionConfig

__all__ = [
    "collect_as_usual",
    "collect_rarely",
    "end_on_signals",
    "forgo_pandas",
    "interrupt_on_terminate",
    "share_heaps",
]


def interrupt_on_terminate() -> None:
    """Treat SIGTERM as Ctrl-C, so that the session policy applies to both."""
    signal.signal(signal.SIGTERM, _interrupt)


def end_on_signals() -> None:
    """Let a signal end the process without a word: all is done, and what it would raise now only a traceback could say."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


_USUAL = gc.get_threshold()
_RARELY = 500_000
"""Objects made between two collections, more than all imports make: what an import makes is never garbage."""


def collect_rarely() -> None:
    """Put collections off while modules are imported: they took an eighth of the start-up."""
    gc.set_threshold(_RARELY, *_USUAL[1:])


def collect_as_usual() -> None:
    """Collect as usual once all is imported, and never look at that again: at the exit alone it took 70 ms."""
    gc.freeze()
    gc.set_threshold(*_USUAL)


class _Absent:
    """Finds no pandas, and leaves every other module to those who look after it."""

    @staticmethod
    def find_spec(name: str, *_where: object) -> ModuleSpec | None:
        if name == "pandas":
            raise ModuleNotFoundError(name)
        return None


def forgo_pandas(configs: Sequence[ROSInjectionConfig] = ()) -> None:
    """Make pyarrow conclude that there is no pandas, unless adapters in Python run: they may pass series.

    Whoever imports pandas later gets it; only pyarrow no longer recognises its objects inside lists.
    """
    if "pandas" in sys.modules or any(map(_runs_python, configs)) or _adapters_installed():
        return
    import numpy as np
    import pyarrow as pa

    sys.meta_path.insert(0, _Absent)
    try:
        pa.array(np.zeros(1))
        pa.array([0])
    finally:
        sys.meta_path.remove(_Absent)


def _runs_python(config: ROSInjectionConfig) -> bool:
    references = (*config.adapters, *config.adapter_override.values())
    return any(not str(reference).endswith((".yaml", ".yml")) for reference in references)


def _adapters_installed() -> bool:
    from mosaico_ingest.adapters.bridge import installed_adapters

    try:
        return bool(installed_adapters())
    except AdapterError:
        return True  # using them says what is wrong


_M_ARENA_MAX = -8
"""glibc's name for the number of heaps."""


def share_heaps(count: int = 2) -> None:
    """Let all threads allocate from a few heaps: a server's many short-lived threads each keep one otherwise.

    Elsewhere than on glibc only Arrow's part is done.
    """
    import pyarrow as pa

    pa.set_memory_pool(pa.system_memory_pool())
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, count)
