"""Helpers of the adapter tests: definitions of standard types, and an adapter bound to dicts."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from mosaico_ingest.adapters.adapter import Adapted, AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BUILTIN
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.definitions.registry import TypeResolver

_OLD_TF = "geometry_msgs/TransformStamped[] transforms\n"
_DATA = {
    "Bool": "bool", "Byte": "byte", "Char": "char", "Float32": "float32", "Float64": "float64",
    "Int8": "int8", "Int16": "int16", "Int32": "int32", "Int64": "int64", "String": "string",
    "UInt8": "uint8", "UInt16": "uint16", "UInt32": "uint32", "UInt64": "uint64", "Time": "time", "Duration": "duration",
}  # fmt: skip
_NOT_IN_THE_DISTROS = {
    **{
        name: text.replace(b.ros_types[0].split("/")[0], name.split("/")[0])
        for b in BUILTIN
        if (text := b.mapping.model.definition)
        for name in b.ros_types
        if "/" in name  # the names of protobuf and JSON types have no package with a slash
    },
    "tf/msg/tfMessage": _OLD_TF,
    **{f"example_interfaces/msg/{name}": f"{kind} data\n" for name, kind in _DATA.items()},
    **{f"std_msgs/msg/{name}": f"{_DATA[name]} data\n" for name in ("Time", "Duration")},
}


@pytest.fixture(scope="session")
def define() -> Callable[..., Definition]:
    """Return the definition of a type in a distro."""
    resolvers: dict[Stores, TypeResolver] = {}

    def definition(msgtype: str, distro: Stores = Stores.LATEST) -> Definition:
        if distro not in resolvers:
            resolvers[distro] = TypeResolver(distro, types=_NOT_IN_THE_DISTROS)
        version = 1 if distro is Stores.ROS1_NOETIC else 2
        return resolvers[distro].resolve(msgtype, None, ros_version=version)

    return definition


@pytest.fixture(scope="session")
def adapt() -> Callable[..., Adapted]:
    """Convert messages, given as dicts, with an adapter."""

    def run(spec: AdapterSpec, definition: Definition, messages: Sequence[dict[str, Any]]) -> Adapted:
        shape = ros_shape(definition)
        envelope = Envelope("/topic", definition.root, np.arange(len(messages), dtype=np.int64))
        return spec.bind(definition, shape).adapt(pa.array(messages, shape), envelope)

    return run


@pytest.fixture(scope="session")
def fuzzed() -> Callable[[Definition, int], list[dict[str, Any]]]:
    """Return random messages of a type; equal seeds return equal messages."""
    message = runpy.run_path(str(Path(__file__).with_name("fuzz.py")))["message"]

    def messages(definition: Definition, count: int, seed: int = 1) -> list[dict[str, Any]]:
        random = Random(seed)  # noqa: S311 - messages, not secrets
        return [message(definition, random) for _ in range(count)]

    return messages
