"""Types and adapters that a program registered, for the processes that run its jobs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct

from mosaico_ingest.adapters.python import register_default_adapter, registered_adapters
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.registry import Registered, ROSTypeRegistry


class Registrations(Struct, frozen=True):
    """The message types and adapters that were registered in a process; a new process starts without them."""

    types: Mapping[Stores | None, Mapping[str, Registered]]
    adapters: tuple[type[Any], ...]

    @classmethod
    def current(cls) -> Registrations:
        """Return the registrations of this process."""
        return cls(ROSTypeRegistry.snapshot(), tuple(dict.fromkeys(registered_adapters().values())))

    def register(self) -> None:
        """Register the types and adapters in this process."""
        ROSTypeRegistry.restore(self.types)
        for adapter in self.adapters:
            register_default_adapter(adapter)
