"""This file reads what a topic's metadata says of the messages it was made of."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import PurePath
from typing import Any, cast

from mosaico_ingest.adapters.metadata import ROS_METADATA_KEY
from mosaico_ingest.bag.definition import Definition, Embedded
from mosaico_ingest.bag.types import TypeResolver
from mosaico_ingest.frozen import frozen
from mosaico_ingest.policies import Stores
from mosaico_ingest.store.model import TopicInfo

__all__ = ["Origin", "origin_of", "version_of"]

_TIME_1 = re.compile(r"^(?:time|duration)(?:\[\d*\])?\s", re.MULTILINE)
_TIME_2 = re.compile(r"^builtin_interfaces/(?:Time|Duration)(?:\[[<=\d]*\])?\s", re.MULTILINE)


@frozen
class Origin:
    """The messages a topic was made of."""

    msgtype: str
    text: str
    """The flattened definition."""
    source_file: str

    @property
    def version(self) -> int | None:
        """The version of ROS its definition can only be of; None where it has no time in it."""
        return 1 if _TIME_1.search(self.text) else 2 if _TIME_2.search(self.text) else None

    def definition(self, version: int) -> Definition:
        """Return the definition, as of a version of ROS.

        Raises:
            BagError: The text cannot be read.
        """
        embedded = Embedded(f"ros{version}msg", self.text)
        return TypeResolver(Stores.EMPTY).resolve(self.msgtype, embedded, ros_version=version)


def origin_of(topic: TopicInfo) -> Origin | None:
    """Return what a topic was made of; None where it does not say."""
    said = topic.metadata.get(ROS_METADATA_KEY)
    if not isinstance(said, dict):
        return None
    values = cast("Mapping[str, Any]", said)
    found = [values.get(key, "") for key in ("msgtype", "msgdef", "source_file")]
    if not all(isinstance(value, str) for value in found) or not found[0]:
        return None
    return Origin(*found)


def version_of(origin: Origin, others: Sequence[Origin], possible: Collection[int]) -> int:
    """Return the version of ROS of a topic: its definition's, else that of the topics it was recorded with."""
    known = [one.version for one in (origin, *others) if one.source_file == origin.source_file]
    said = next((version for version in known if version is not None), None)
    if said is None:
        said = 1 if PurePath(origin.source_file).suffix == ".bag" else 2
    return said if said in possible or origin.version is not None else min(possible)
