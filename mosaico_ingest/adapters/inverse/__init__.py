"""The way back: an adapter that is bound to a message type, and stored rows in; messages in the ROS shape out.

What a mapping moves it moves back; what it computes is undone where that is possible. Whether it was possible is not
believed but tried: the messages go through the adapter once more, and what then differs is counted.
"""

from __future__ import annotations

from mosaico_ingest.adapters.inverse.inverse import Inverse, Restored, invert

__all__ = ["Inverse", "Restored", "invert"]
