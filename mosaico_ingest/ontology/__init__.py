"""Typed models and their exact Arrow columns; knows nothing of ROS.

`from mosaico_ingest.ontology import IMU` imports that model and what it is made of; nothing is imported before.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from mosaico_ingest.ontology.tags import MODULES

_NAMES = {
    **MODULES,
    "ImageFormat": "image",
    "Message": "message",
    "OntologyType": "types",
    "PointFieldDataType": "point_cloud",
    "Serializable": "serializable",
    "SerializationFormat": "types",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any of the names
    """Import the module that defines `name`."""
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_NAMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_NAMES})
