"""Declarative ingestion of ROS recordings into typed, queryable Mosaico sequences.

The public names are imported on first access, so that `import mosaico_ingest` loads neither Arrow nor pydantic.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from mosaico_ingest.version import __version__

if TYPE_CHECKING:
    from mosaico_ingest.adapters import ROSAdapterBase, register_default_adapter
    from mosaico_ingest.adapters.bridge import ROSBridge
    from mosaico_ingest.api import RosbagInjector
    from mosaico_ingest.job.config import ROSInjectionConfig
    from mosaico_ingest.job.values import (
        IfExists,
        LoaderErrorPolicy,
        SessionLevelErrorPolicy,
        Stores,
        TopicLevelErrorPolicy,
    )
    from mosaico_ingest.ontology import Message, Serializable
    from mosaico_ingest.protocol.messages import Permission as APIKeyPermissionEnum
    from mosaico_ingest.rosbag.blocks import ROSMessage
    from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry
    from mosaico_ingest.rosbag.loader import ROSLoader

__all__ = [
    "APIKeyPermissionEnum",
    "IfExists",
    "LoaderErrorPolicy",
    "Message",
    "ROSAdapterBase",
    "ROSBridge",
    "ROSInjectionConfig",
    "ROSLoader",
    "ROSMessage",
    "ROSTypeRegistry",
    "RosbagInjector",
    "Serializable",
    "SessionLevelErrorPolicy",
    "Stores",
    "TopicLevelErrorPolicy",
    "__version__",
    "register_default_adapter",
]

_MODULES = {
    "IfExists": "job.values",
    "LoaderErrorPolicy": "job.values",
    "Message": "ontology",
    "ROSAdapterBase": "adapters",
    "ROSBridge": "adapters.bridge",
    "ROSInjectionConfig": "job.config",
    "ROSLoader": "rosbag.loader",
    "ROSMessage": "rosbag.blocks",
    "ROSTypeRegistry": "rosbag.definitions.registry",
    "RosbagInjector": "api",
    "Serializable": "ontology",
    "SessionLevelErrorPolicy": "job.values",
    "Stores": "job.values",
    "TopicLevelErrorPolicy": "job.values",
    "register_default_adapter": "adapters",
}
"""The module of each public name; it is imported on first access, so that `ingest --help` does not load Arrow."""


def __getattr__(name: str) -> object:
    if name == "APIKeyPermissionEnum":
        return import_module(f"{__name__}.protocol.messages").Permission
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
