"""The adapters of `geometry_msgs`, as in the official SDK."""

from mosaico_ingest.adapters import (
    AccelAdapter,
    InertiaAdapter,
    PointAdapter,
    PolygonAdapter,
    PoseAdapter,
    QuaternionAdapter,
    TransformAdapter,
    TwistAdapter,
    Vector3Adapter,
    WrenchAdapter,
)

__all__ = [
    "AccelAdapter",
    "InertiaAdapter",
    "PointAdapter",
    "PolygonAdapter",
    "PoseAdapter",
    "QuaternionAdapter",
    "TransformAdapter",
    "TwistAdapter",
    "Vector3Adapter",
    "WrenchAdapter",
]
