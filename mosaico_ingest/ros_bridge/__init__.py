"""The public names of the official `mosaicolabs.ros_bridge`, re-exported from this package.

Programs written for the official module run with `mosaicolabs` replaced by `mosaico_ingest`. The package contains no
code of its own, and no other module of this project may depend on it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import mosaico_ingest
from mosaico_ingest import ontology

if TYPE_CHECKING:
    from mosaico_ingest import (
        LoaderErrorPolicy,
        ROSAdapterBase,
        RosbagInjector,
        ROSBridge,
        ROSInjectionConfig,
        ROSLoader,
        ROSMessage,
        ROSTypeRegistry,
        Stores,
        register_default_adapter,
    )
    from mosaico_ingest.export.official_bridge import (
        MosaicoToROSLoader,
        ROSExtractorConfig,
        ROSSequenceExtractor,
    )
    from mosaico_ingest.ontology import BatteryState, FrameTransform, PointCloud2, PointField
    from mosaico_ingest.rosbag.blocks import ROSHeader

__all__ = [
    "BatteryState",
    "FrameTransform",
    "LoaderErrorPolicy",
    "MosaicoToROSLoader",
    "PointCloud2",
    "PointField",
    "ROSAdapterBase",
    "ROSBridge",
    "ROSExtractorConfig",
    "ROSHeader",
    "ROSInjectionConfig",
    "ROSLoader",
    "ROSMessage",
    "ROSSequenceExtractor",
    "ROSTypeRegistry",
    "RosbagInjector",
    "Stores",
    "register_default_adapter",
]

_MODULES = {
    "MosaicoToROSLoader": "mosaico_ingest.export.official_bridge",
    "ROSExtractorConfig": "mosaico_ingest.export.official_bridge",
    "ROSHeader": "mosaico_ingest.rosbag.blocks",
    "ROSSequenceExtractor": "mosaico_ingest.export.official_bridge",
}
"""The module of each name that the package `mosaico_ingest` does not export."""


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    return getattr(mosaico_ingest if name in mosaico_ingest.__all__ else ontology, name)
