"""This file is the distros' own message types, loaded when the first one is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, lru_cache

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.bag.definition import Field, MessageType
from mosaico_ingest.bag.names import DURATION, TIME
from mosaico_ingest.bag.schemas import message_type
from mosaico_ingest.policies import Stores

__all__ = ["BEFORE_IRON", "BUILTIN", "ROS1", "ROS2", "agreed_type", "distro_type", "ros_version"]

_PARTS = (Field("sec", "int32"), Field("nanosec", "uint32"))
BUILTIN: Mapping[str, MessageType] = {name: MessageType(name, _PARTS) for name in (TIME, DURATION)}
"""The types every distro has and a ROS 1 text spells `time` and `duration`."""


ROS1 = (Stores.ROS1_NOETIC,)
BEFORE_IRON = (
    Stores.ROS2_DASHING, Stores.ROS2_ELOQUENT, Stores.ROS2_FOXY, Stores.ROS2_GALACTIC, Stores.ROS2_HUMBLE,
)  # fmt: skip
"""The distros whose recordings hold no definitions."""
ROS2 = (*BEFORE_IRON, Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL)


def ros_version(distro: Stores) -> int | None:
    """Return 1 or 2; None for the store without a distro."""
    if distro is Stores.EMPTY:
        return None
    return 1 if distro.value.startswith("ros1") else 2


def distro_type(distro: Stores, name: str) -> MessageType | None:
    """Return a distro's type by full name, None where it has none."""
    if name.count("/") != 2:  # noqa: PLR2004 - as in pkg/msg/Name; loading a distro takes a while
        return None
    types = _types(distro)
    return message_type(name, types) if name in types else None


@lru_cache(maxsize=4096)
def agreed_type(name: str, distros: tuple[Stores, ...]) -> MessageType | None:
    """Return the type if all of the distros that have it agree on its fields; the last one's form."""
    found = [known for distro in distros if (known := distro_type(distro, name))]
    return found[-1] if found and all(known.fields == found[0].fields for known in found) else None


@cache
def _types(distro: Stores) -> Typesdict:
    return get_typestore(RosbagsStores(distro.value)).fielddefs
