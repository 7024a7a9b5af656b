"""Inverted adapters: stored rows and the adapter that produced them in, rows in the shape of the ROS type out.

Each result is verified: the restored messages are adapted again, and rows that differ from the stored ones are counted.
The package must not depend on the store or on the writers of containers.
"""

from __future__ import annotations

from mosaico_ingest.adapters.inverse.restore import Inverse, Restored, invert

__all__ = ["Inverse", "Restored", "invert"]
