"""This file finds message definitions where there is no recording: one's own, the newest distro's, ROS 1's."""

from __future__ import annotations

from collections.abc import Iterable

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.builtin import Builtin
from mosaico_ingest.adapters.mapping.load import MappingSpec
from mosaico_ingest.bag.definition import Definition, Embedded
from mosaico_ingest.bag.registry import store_of
from mosaico_ingest.bag.types import CustomMessages, TypeResolver
from mosaico_ingest.errors import BagError
from mosaico_ingest.policies import Stores

__all__ = ["KnownTypes", "mapping_of"]


class KnownTypes:
    """Finds definitions by type alone; satisfies `Resolver`."""

    def __init__(self, distro: Stores | str | None = None, custom: Iterable[CustomMessages] = ()) -> None:
        """Look in `custom` first, then in `distro`; None: the newest of ROS 2, and Noetic.

        Raises:
            BagError: A definition of `custom` cannot be read, or there is no such distro.
        """
        named, own = store_of(distro), tuple(custom)
        one = named is not None and named.value.startswith("ros1")
        self._resolvers = {
            1: TypeResolver(named if named and one else Stores.ROS1_NOETIC, own),
            2: TypeResolver(named if named and not one else Stores.LATEST, own),
        }
        self._first, self._second = (1, 2) if one else (2, 1)

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of a type in a version of ROS.

        Raises:
            BagError: It is not known there.
        """
        return self._resolvers[ros_version].resolve(msgtype, embedded, ros_version=ros_version)

    def find(self, msgtype: str, spec: AdapterSpec | None = None) -> Definition:
        """Return the definition of a type in either version, an adapter's own text before any other.

        Raises:
            BagError: It is not known.
        """
        mapping = mapping_of(spec) if spec else None
        text = mapping.own_text(msgtype) if mapping else None
        embedded = Embedded("ros2msg", text) if text else None
        try:
            return self.resolve(msgtype, embedded, ros_version=self._first)
        except BagError as unknown:
            try:
                return self.resolve(msgtype, embedded, ros_version=self._second)
            except BagError:
                raise unknown from None


def mapping_of(spec: AdapterSpec) -> MappingSpec | None:
    """Return what an adapter's file says; None of one written in Python."""
    if isinstance(spec, Builtin):
        return spec.mapping
    return spec if isinstance(spec, MappingSpec) else None
