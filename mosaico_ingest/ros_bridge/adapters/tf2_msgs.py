"""The adapters of `tf2_msgs`, as in the official SDK."""

from mosaico_ingest.adapters import FrameTransformAdapter

__all__ = ["FrameTransformAdapter"]
