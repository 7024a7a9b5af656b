"""The adapters that a topic must select with an override, as in the official SDK."""

from mosaico_ingest.adapters import (
    LidarAdapter,
    RadarAdapter,
    RGBDCameraAdapter,
    StereoCameraAdapter,
    ToFCameraAdapter,
)

__all__ = ["LidarAdapter", "RGBDCameraAdapter", "RadarAdapter", "StereoCameraAdapter", "ToFCameraAdapter"]
