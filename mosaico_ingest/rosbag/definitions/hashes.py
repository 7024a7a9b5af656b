"""This file computes the hashes that recordings carry of message types: RIHS01 in ROS 2, MD5 in ROS 1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import Definition

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = ["definition_difference", "md5sum", "rihs01"]

_ANY = "*"
"""What a ROS 1 subscriber writes that takes every form of a type."""


def rihs01(definition: Definition) -> str:
    """Return the hash that ROS 2 gives a type.

    Raises:
        BagError: The type has what the hash does not describe here.
    """
    try:
        return _store(definition).hash_rihs01(definition.root)
    except KeyError as error:  # how rosbags says that it does not know wstring, nor the events of services
        raise BagError(f"{definition.root} needs {error}, which has no hash") from error


def md5sum(definition: Definition) -> str:
    """Return the hash that ROS 1 gives a type.

    Raises:
        BagError: The type cannot be spelled in ROS 1.
    """
    return _store(definition).generate_msgdef(definition.root, ros_version=1)[1]


def definition_difference(definition: Definition, attributes: Mapping[str, str]) -> str | None:
    """Return how a definition differs from the hash a connection carries; None where it does not, or nothing is known."""
    if definition.ros_version == 1:
        recorded, compute = attributes.get("md5sum", _ANY), md5sum
    else:
        recorded = attributes.get("type_description_hash") or attributes.get("topic_type_hash") or _ANY
        compute = rihs01
    try:
        known = recorded if recorded == _ANY else compute(definition)
    except BagError:
        return None
    return None if known == recorded else f"the recording's is {recorded}, that of the known one is {known}"


def _store(definition: Definition) -> Typestore:
    from rosbags.typesys import (  # noqa: PLC0415 - slow to import, and few recordings carry hashes and no definitions
        Stores,
        TypesysError,
        get_types_from_msg,
        get_typestore,
    )

    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition.text, definition.root))
    except TypesysError as error:
        raise BagError(f"{definition.root} cannot be written: {error}") from error
    return store
