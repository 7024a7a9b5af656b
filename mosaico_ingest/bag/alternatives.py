"""This file knows the other definitions a type has had, to name the one that bytes would fit."""

from __future__ import annotations

from mosaico_ingest.bag.definition import Definition, Source
from mosaico_ingest.bag.distros import BUILTIN, ROS1, ROS2, distro_type
from mosaico_ingest.bag.link import link
from mosaico_ingest.bag.msgtext import flatten

__all__ = ["distro_definitions"]


def distro_definitions(msgtype: str, ros_version: int) -> tuple[tuple[str, Definition], ...]:
    """Return the definitions that the distros of a ROS version have of a type, each with the newest that has it."""
    found = dict[str, tuple[str, Definition]]()
    for distro in ROS1 if ros_version == 1 else ROS2:
        root = distro_type(distro, msgtype)
        if root:
            types = link(
                root,
                lambda name, distro=distro: distro_type(distro, name) or BUILTIN.get(name),
                ros_version=ros_version,
                hint="",
            )
            text = flatten(msgtype, types, ros_version=ros_version)
            found[text] = distro.value, Definition(msgtype, types, Source.DISTRO, text, ros_version)
    return tuple(found.values())
