"""This file puts one message, a dict, through an adapter that works on columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any, cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.definitions import mapping_of
from mosaico_ingest.adapters.python_adapter import PythonAdapterSpec
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.message import ROSMessage
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.bag.types import TypeResolver
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.ontology.message import Message
from mosaico_ingest.ontology.registry import model
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.policies import Stores

__all__ = ["adapt_dict", "metadata_of", "translate"]

_DISTROS = (Stores.LATEST, Stores.ROS2_HUMBLE, Stores.ROS2_FOXY, Stores.ROS1_NOETIC)
"""Where the definition of a dict is looked for: the first whose fields include the dict's is taken."""


def translate(spec: AdapterSpec, msg: ROSMessage) -> Message:
    """Return the ontology's object for one message, with its time.

    Raises:
        AdapterError: The message does not fit.
    """
    if isinstance(spec, PythonAdapterSpec):
        return spec.adapter.translate(msg)
    data = adapt_dict(spec, msg.data, msg.msg_type)
    return Message(timestamp_ns=msg.bag_timestamp_ns, data=data)


def adapt_dict(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> Serializable:
    """Return the ontology's object for the fields of one message; of several types the first the dict fits.

    Raises:
        AdapterError: A field is unknown or missing, or a value does not fit.
    """
    adapter, rows, name = _bind(spec, ros_data, msgtype)
    adapted = adapter.adapt(rows, Envelope("", name, np.zeros(1, np.int64)))
    if adapted.failures:
        raise AdapterError(f"{spec.name}: {adapted.failures[0].reason}")
    return model(adapter.ontology.tag).from_row(cast("dict[str, Any]", adapted.rows[0].as_py()))


def metadata_of(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> dict[str, Any]:
    """Return the topic metadata the adapter reads from a first message."""
    adapter, rows, _ = _bind(spec, ros_data, msgtype)
    return adapter.topic_metadata(rows[0])


def _bind(
    spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None
) -> tuple[Adapter, pa.StructArray, str]:
    own = () if msgtype is None else (normalize_msgtype(msgtype),)
    misfits: list[str] = []
    for definition in _candidates(spec, own):
        shape = ros_shape(definition)
        unknown = next(_unknown(ros_data, shape, ""), None)
        if unknown is None:
            return spec.bind(definition, shape), _row(ros_data, shape, spec.name), definition.root
        misfits.append(f"{definition.root} has no field {unknown}")
    known = f"no distro knows {', '.join(own or spec.ros_types)}"
    raise AdapterError(f"{spec.name}: {misfits[0] if misfits else known}")


def _candidates(spec: AdapterSpec, own: tuple[str, ...]) -> Iterator[Definition]:
    """Yield what the message may look like: its own type in any distro, then the other types the adapter takes."""
    mapping = mapping_of(spec)
    for name in dict.fromkeys((*own, *spec.ros_types)):
        yield from _versions(name, mapping.own_text(name) if mapping else None)


@cache
def _versions(msgtype: str, text: str | None) -> tuple[Definition, ...]:
    """Return a type as the distros have it, or as an adapter's own text says."""
    found: list[Definition] = []
    for distro in _DISTROS:
        version = 1 if distro is Stores.ROS1_NOETIC else 2
        own = {msgtype: text} if text else None
        with suppress(BagError):
            found.append(TypeResolver(distro, types=own).resolve(msgtype, None, ros_version=version))
    return tuple(found)


def _unknown(ros_data: Mapping[str, Any], shape: pa.StructType, where: str) -> Iterator[str]:
    """Yield the keys that are no fields, nested ones too."""
    fields = {field.name: field.type for field in shape}
    for name, value in ros_data.items():
        if name not in fields:
            yield f"{where}{name}"
            continue
        kind: Any = fields[name]
        items = value if isinstance(value, (list, tuple)) else (value,)
        kind = kind.value_type if hasattr(kind, "value_type") else kind
        if pa.types.is_struct(kind):
            for item in items:
                if isinstance(item, Mapping):
                    yield from _unknown(cast("Mapping[str, Any]", item), kind, f"{where}{name}.")


def _row(ros_data: Mapping[str, Any], shape: pa.StructType, name: str) -> pa.StructArray:
    try:
        return cast("pa.StructArray", pa.array([ros_data], shape))
    except (pa.ArrowException, TypeError, ValueError, OverflowError) as error:
        raise AdapterError(f"{name}: {error}") from error
