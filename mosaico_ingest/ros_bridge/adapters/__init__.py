"""The built-in adapters as classes, under the module names of the official SDK.

The classes are those of `mosaico_ingest.adapters`.
"""

from __future__ import annotations

from mosaico_ingest import adapters

__all__: list[str] = []


def __getattr__(name: str) -> object:
    return getattr(adapters, name)


def __dir__() -> list[str]:
    return dir(adapters)
