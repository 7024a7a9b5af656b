"""The public names of `mosaicolabs.bridges.ros`, as in `mosaico_ingest.ros_bridge`.

The package must not contain code of its own.
"""

from __future__ import annotations

from mosaico_ingest import ros_bridge
from mosaico_ingest.ros_bridge import __all__ as __all__

__path__ = list(ros_bridge.__path__)  # so that `bridges.ros.adapters` is importable, too


def __getattr__(name: str) -> object:
    return getattr(ros_bridge, name)
