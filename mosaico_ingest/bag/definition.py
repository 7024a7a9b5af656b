"""This file is a message type as data: names resolved once, before any loop over messages."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Protocol

from mosaico_ingest.frozen import frozen

__all__ = ["Constant", "Container", "Definition", "Embedded", "Field", "MessageType", "Resolver", "Source"]


class Container(str, Enum):
    """How many values a field holds."""

    SCALAR = "scalar"
    ARRAY = "array"
    """A fixed number of them, without a length word."""
    SEQUENCE = "sequence"
    """Any number up to the bound, behind a length word."""


class Source(str, Enum):
    """Where a definition was found, in the order of preference."""

    BAG = "bag"
    CUSTOM = "custom"
    DISTRO = "distro"
    PACKAGE = "package"
    """A public package that no distro's core has."""


@frozen
class Field:
    """One field: `type` is a primitive (`float64`, `string`, `wstring`, …) or a full message type name."""

    name: str
    type: str
    is_message: bool = False
    container: Container = Container.SCALAR
    size: int = 0
    """The length of an array, the bound of a sequence (0: unbounded)."""
    string_bound: int = 0
    """What `string<=N` says (0: unbounded); the bytes do not depend on it."""


@frozen
class Constant:
    """A named value of a message type, as `uint8 STATUS_FIX=0`."""

    name: str
    type: str
    value: str | bool | int | float


@frozen
class MessageType:
    """A message type's own fields and constants; `name` is `pkg/msg/Name`, also for ROS 1."""

    name: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...] = ()


@frozen
class Definition:
    """A message type with every type it needs, and where it came from."""

    root: str
    types: Mapping[str, MessageType]
    source: Source
    text: str
    """The flattened `.msg` text: nested types follow 80 `=` and `MSG: pkg/Name`."""
    ros_version: int
    """1 or 2: the form of `time` and of the header."""

    @property
    def message(self) -> MessageType:
        """The type this definition is about."""
        return self.types[self.root]


@frozen
class Embedded:
    """The definition text a recording carries for a type, as it stands there."""

    encoding: str
    """`ros1msg`, `ros2msg`, `ros2idl`, or what else the recording calls it."""
    text: str


class Resolver(Protocol):
    """Finds the definition of a type: embedded first, then the caller's own, then the distro's and known packages'."""

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of `msgtype`, any spelling of the name.

        Raises:
            BagError: None is known, or the one in the recording cannot be read; the text says which.
        """
        ...
