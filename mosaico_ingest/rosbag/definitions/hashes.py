"""The hashes of message types in recordings: RIHS01 in ROS 2, MD5 in ROS 1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import Definition

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_ANY = "*"
"""The MD5 sum that a ROS 1 subscriber writes to accept every form of a type."""


def rihs01(definition: Definition) -> str:
    """Return the ROS 2 hash of a type.

    Raises:
        BagError: rosbags cannot hash the type.
    """
    try:
        return _store(definition).hash_rihs01(definition.root)
    except KeyError as error:  # rosbags raises KeyError for wstring and for service events
        raise BagError(f"{definition.root} needs {error}, which has no hash") from error


def md5sum(definition: Definition) -> str:
    """Return the ROS 1 MD5 sum of a type.

    Raises:
        BagError: The type cannot be written in ROS 1.
    """
    return _store(definition).generate_msgdef(definition.root, ros_version=1)[1]


def definition_difference(definition: Definition, attributes: Mapping[str, str]) -> str | None:
    """Return how the hash of a definition differs from the recorded one; None if they are equal or unknown."""
    if definition.ros_version == 1:
        recorded, compute = attributes.get("md5sum", _ANY), md5sum
    else:
        recorded = attributes.get("type_description_hash") or attributes.get("topic_type_hash") or _ANY
        compute = rihs01
    try:
        computed = recorded if recorded == _ANY else compute(definition)
    except BagError:
        return None
    return None if computed == recorded else f"the recorded hash is {recorded}, the known one is {computed}"


def _store(definition: Definition) -> Typestore:
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore  # noqa: PLC0415 - slow to import, and few recordings carry hashes and no definitions

    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition.text, definition.root))
    except TypesysError as error:
        raise BagError(f"{definition.root} cannot be written: {error}") from error
    return store
