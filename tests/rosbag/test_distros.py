from __future__ import annotations

import pytest
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.registry import distro_type
from mosaico_ingest.rosbag.definitions.rosbags_types import message_type


@pytest.mark.parametrize("distro", Stores)
def test_distro_types_equal_those_of_rosbags(distro: Stores) -> None:
    types = get_typestore(RosbagsStores(distro.value)).fielddefs
    for name in types if distro is not Stores.EMPTY else ():
        assert distro_type(distro, name) == message_type(name, types)


def test_distro_type_of_another_distro_is_none() -> None:
    assert distro_type(Stores.ROS1_NOETIC, "rcl_interfaces/msg/Log") is None
    assert distro_type(Stores.EMPTY, "std_msgs/msg/Header") is None
    assert distro_type(Stores.LATEST, "Header") is None
