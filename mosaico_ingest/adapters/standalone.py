"""Use adapters without a recording: one message at a time, and built-in adapters as classes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Any, ClassVar, cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.adapters.adapter import Adapter, AdapterSpec, Envelope
from mosaico_ingest.adapters.builtin import BY_NAME, Builtin
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.python import PythonAdapterSpec, ROSAdapterBase
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.ontology.header import Message
from mosaico_ingest.ontology.model import Serializable
from mosaico_ingest.ontology.registry import model
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, TypeResolver, store_of

__all__ = [
    "CatalogAdapter",
    "DefinitionFinder",
    "adapt_dict",
    "adapter_class",
    "mapping_of",
    "metadata_of",
    "translate",
]


class DefinitionFinder:
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


class CatalogAdapter(ROSAdapterBase[Serializable]):
    """A built-in adapter as a class: for an override, for single messages, as the base of one's own."""

    __adapter_spec__: ClassVar[Builtin]

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> Serializable:
        """Return the ontology's object for the fields of one message.

        Raises:
            AdapterError: A field is unknown or missing, or a value does not fit.
        """
        return adapt_dict(cls.__adapter_spec__, ros_data)

    @classmethod
    def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:  # noqa: ANN401 - the base's
        """Return the object with its time, read as the message's own type."""
        if "__adapter_spec__" in vars(cls):
            return translate(cls.__adapter_spec__, ros_msg)
        return super().translate(ros_msg, **kwargs)

    @classmethod
    def schema_metadata(
        cls,
        ros_data: dict[str, Any],
        **kwargs: Any,  # noqa: ANN401, ARG003 - the base's
    ) -> dict[str, Any] | None:
        """Return the topic metadata the adapter reads from a first message."""
        return metadata_of(cls.__adapter_spec__, ros_data) or None


@cache
def adapter_class(name: str) -> type[CatalogAdapter]:
    """Return the class of a built-in adapter, as `IMUAdapter`; KeyError where there is none."""
    builtin = BY_NAME[name]
    members = {
        "__doc__": builtin.mapping.model.description,
        "__module__": __package__,
        "__adapter_spec__": builtin,
        "__mosaico_ontology_type__": model(builtin.tag),
        "ros_msgtype": builtin.ros_types,
    }
    return type(name, (CatalogAdapter,), members)
