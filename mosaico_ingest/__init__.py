"""Declarative ingestion of ROS recordings into typed, queryable Mosaico sequences.

Start with these names:

    run("job.yaml")                  ingest the recordings of a manifest; returns the report
    plan("job.yaml")                 decide everything and try a few messages; writes nothing
    check("job.yaml")                check recordings against a data contract; writes nothing
    inspect("drive.mcap")            list the topics of a recording
    Store.open("mosaico")            open a store; then .sequence("drive").topic("/imu").to_pandas()
    ROSInjectionConfig               a job in Python instead of a manifest
    RosbagInjector                   plan or run one ROSInjectionConfig
    ROSLoader                        iterate over the messages of a recording
    ROSBridge                        the adapters of message types
    ROSAdapterBase                   the base class of your own adapters

Reports, plans, stores, sequences and topics are shown as tables in notebooks. The public names are imported on first
access, so that `import mosaico_ingest` loads neither Arrow nor pydantic.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from mosaico_ingest.version import __version__

if TYPE_CHECKING:
    from mosaico_ingest.adapters import ROSAdapterBase, register_default_adapter
    from mosaico_ingest.adapters.bridge import ROSBridge
    from mosaico_ingest.api import RosbagInjector, check, run
    from mosaico_ingest.api import inspect_recording as inspect
    from mosaico_ingest.api import plan_job as plan
    from mosaico_ingest.destinations.store import Store
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
    from mosaico_ingest.report.recording import Report
    from mosaico_ingest.report.run import RunReport
    from mosaico_ingest.rosbag.blocks import ROSMessage
    from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry
    from mosaico_ingest.rosbag.loader import ROSLoader
    from mosaico_ingest.view.rows import align

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
    "Report",
    "RosbagInjector",
    "RunReport",
    "Serializable",
    "SessionLevelErrorPolicy",
    "Store",
    "Stores",
    "TopicLevelErrorPolicy",
    "__version__",
    "align",
    "check",
    "inspect",
    "plan",
    "register_default_adapter",
    "run",
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
    "Report": "report.recording",
    "RosbagInjector": "api",
    "RunReport": "report.run",
    "Serializable": "ontology",
    "SessionLevelErrorPolicy": "job.values",
    "Store": "destinations.store",
    "Stores": "job.values",
    "TopicLevelErrorPolicy": "job.values",
    "align": "view.rows",
    "check": "api",
    "inspect": "api",
    "plan": "api",
    "register_default_adapter": "adapters",
    "run": "api",
}
"""The module of each public name; it is imported on first access, so that `ingest --help` does not load Arrow."""


_FULL_NAMES = {"inspect": "inspect_recording", "plan": "plan_job"}
"""The name in its module, where the public name differs."""

if not TYPE_CHECKING:  # type checkers report unknown names

    def __getattr__(name: str) -> object:
        if name == "APIKeyPermissionEnum":
            return import_module(f"{__name__}.protocol.messages").Permission
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), _FULL_NAMES.get(name, name))


def __dir__() -> list[str]:
    return sorted(__all__)
