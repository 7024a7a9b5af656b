"""Adapters inverted: an adapter bound to a message type and stored rows in, messages in the ROS shape out.

Values that a mapping moved are moved back, those it computed are computed back where that is possible. The result is
checked: the messages are adapted once more, and rows that differ are counted.
"""

from __future__ import annotations

from mosaico_ingest.adapters.inverse.restore import Inverse, Restored, invert

__all__ = ["Inverse", "Restored", "invert"]
