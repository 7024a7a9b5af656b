"""This file is the distros' own message types, read from `distros.json`: to load them from rosbags takes 0.1 s.

The file says of each type which distros have it in which form, as `.msg` text with full names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path

from mosaico_ingest.bag.definition import Field, MessageType
from mosaico_ingest.bag.msgtext import parse_msg
from mosaico_ingest.bag.names import DURATION, TIME
from mosaico_ingest.policies import Stores

__all__ = ["BEFORE_IRON", "BUILTIN", "FILE", "ROS1", "ROS2", "agreed_type", "distro_type", "ros_version"]

FILE = Path(__file__).with_name("distros.json")
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
    forms = _known().get(name, {})
    text = next((text for having, text in forms.items() if distro.value in having.split()), None)
    return None if text is None else _form(name, text)


@lru_cache(maxsize=4096)
def agreed_type(name: str, distros: tuple[Stores, ...]) -> MessageType | None:
    """Return the type if all of the distros that have it agree on its fields; the last one's form."""
    found = [known for distro in distros if (known := distro_type(distro, name))]
    return found[-1] if found and all(known.fields == found[0].fields for known in found) else None


@cache
def _known() -> Mapping[str, Mapping[str, str]]:
    return json.loads(FILE.read_bytes())


@cache
def _form(name: str, text: str) -> MessageType:
    return parse_msg(text, name)
