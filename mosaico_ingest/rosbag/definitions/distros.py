"""Definitions shipped with the package: ROS distros and public packages.

`distros.json` maps each type name to its forms (`.msg` text with full names) and the distros that use each form. It is
generated from the type stores of rosbags, because importing those at run time is slow.

`packages/` contains the fields of public packages; their licenses are listed in `packages/README.md`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path

from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import link
from mosaico_ingest.rosbag.definitions.model import DURATION, TIME, Definition, Field, MessageType, Source
from mosaico_ingest.rosbag.definitions.parser import flatten, parse_msg, read_types

FILE = Path(__file__).with_name("distros.json")
_PARTS = (Field("sec", "int32"), Field("nanosec", "uint32"))
BUILTIN: Mapping[str, MessageType] = {name: MessageType(name, _PARTS) for name in (TIME, DURATION)}
"""The types that every distro has, and that ROS 1 calls `time` and `duration`."""


ROS1 = (Stores.ROS1_NOETIC,)
BEFORE_IRON = (
    Stores.ROS2_DASHING, Stores.ROS2_ELOQUENT, Stores.ROS2_FOXY, Stores.ROS2_GALACTIC, Stores.ROS2_HUMBLE,
)  # fmt: skip
"""The distros whose recordings contain no definitions."""
ROS2 = (*BEFORE_IRON, Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL)


def ros_version(distro: Stores) -> int | None:
    """Return the ROS version of a distro, 1 or 2; None for `Stores.EMPTY`."""
    if distro is Stores.EMPTY:
        return None
    return 1 if distro.value.startswith("ros1") else 2


def distro_type(distro: Stores, name: str) -> MessageType | None:
    """Return a distro's type by full name, None if the distro does not have it."""
    forms = _distro_types().get(name, {})
    text = next((text for having, text in forms.items() if distro.value in having.split()), None)
    return None if text is None else _form(name, text)


@lru_cache(maxsize=4096)
def agreed_type(name: str, distros: tuple[Stores, ...]) -> MessageType | None:
    """Return the newest form of a type if all distros that have it agree on its fields, else None."""
    forms = [form for distro in distros if (form := distro_type(distro, name))]
    return forms[-1] if forms and all(form.fields == forms[0].fields for form in forms) else None


@cache
def _distro_types() -> Mapping[str, Mapping[str, str]]:
    return json.loads(FILE.read_bytes())


@cache
def _form(name: str, text: str) -> MessageType:
    return parse_msg(text, name)


_FOLDER = Path(__file__).parent / "packages"


def package_type(name: str) -> MessageType | None:
    """Return a ROS 2 type of a public package by full name, None if no shipped package has it."""
    return _types(name.partition("/")[0]).get(name)


@cache
def _package_names() -> frozenset[str]:
    return frozenset(path.stem for path in _FOLDER.glob("*.txt"))


@cache
def _types(package: str) -> Mapping[str, MessageType]:
    if package not in _package_names():
        return {}
    path = _FOLDER / f"{package}.txt"
    return read_types(path.read_text(encoding="utf-8"), package, where=str(path))


def distro_definitions(msgtype: str, ros_version: int) -> tuple[tuple[str, Definition], ...]:
    """Return the distinct definitions of a type in the distros of a ROS version, each with the newest distro that has it."""
    definitions = dict[str, tuple[str, Definition]]()
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
            definitions[text] = distro.value, Definition(msgtype, types, Source.DISTRO, text, ros_version)
    return tuple(definitions.values())
