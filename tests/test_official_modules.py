"""The modules of the official SDK exist under the same names, with the classes of this package."""

from __future__ import annotations

from importlib import import_module

import pytest


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("ros_bridge", "ROSBridge"),
        ("ros_bridge", "FrameTransform"),
        ("ros_bridge", "ROSHeader"),
        ("bridges.ros", "ROSExtractorConfig"),
        ("bridges.ros", "ROSSequenceExtractor"),
        ("bridges.ros", "MosaicoToROSLoader"),
        ("ros_bridge.adapters", "IMUAdapter"),
        ("ros_bridge.adapters.sensor_msgs", "IMUAdapter"),
        ("ros_bridge.adapters.override_msgs", "LidarAdapter"),
        ("bridges.ros", "RosbagInjector"),
        ("bridges.ros.adapters", "PoseAdapter"),
        ("bridges.ros.adapters.geometry_msgs", "PoseAdapter"),
        ("models", "Message"),
        ("models", "IMU"),
        ("models.core", "Serializable"),
        ("models.data", "Pose"),
        ("models.sensors", "Image"),
        ("models.futures", "Lidar"),
    ],
)
def test_official_module_exports_name(module: str, name: str) -> None:
    assert hasattr(import_module(f"mosaico_ingest.{module}"), name)


def test_bridge_modules_export_the_same_classes() -> None:
    for name in ("ROSBridge", "ROSAdapterBase", "RosbagInjector"):
        classes = {
            getattr(import_module(module), name)
            for module in ("mosaico_ingest", "mosaico_ingest.ros_bridge", "mosaico_ingest.bridges.ros")
        }
        assert len(classes) == 1


def test_ros_bridge_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Nonsense"):
        import_module("mosaico_ingest.ros_bridge").Nonsense  # noqa: B018 - the access is under test
