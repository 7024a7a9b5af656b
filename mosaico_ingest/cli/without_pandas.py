"""This file keeps pyarrow from importing pandas, which takes longer than reading a short recording."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec

from mosaico_ingest.config import ROSInjectionConfig
from mosaico_ingest.errors import AdapterError

__all__ = ["forgo_pandas"]


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
    from mosaico_ingest.bridge import installed_adapters

    try:
        return bool(installed_adapters())
    except AdapterError:
        return True  # using them says what is wrong
