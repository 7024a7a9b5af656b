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
from mosaico_ingest.adapters.inverse import invert
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.adapters.python import PythonAdapterSpec, ROSAdapterBase, ros_types_of
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.ontology.header import Message
from mosaico_ingest.ontology.model import Serializable
from mosaico_ingest.ontology.registry import model
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, ROSTypeRegistry, TypeResolver, store_of
from mosaico_ingest.rosbag.definitions.rosbags_types import definition_in, native_message


class DefinitionFinder:
    """Finds definitions by type name; implements `Resolver`."""

    def __init__(
        self,
        distro: Stores | str | None = None,
        custom: Iterable[CustomMessages] = (),
        registry: type[ROSTypeRegistry] = ROSTypeRegistry,
        types: Mapping[str, str] | None = None,
    ) -> None:
        """Look up types in `custom` and `types`, then in `registry`, then in `distro`, by default the newest ROS 2 and ROS 1 Noetic.

        Raises:
            BagError: A definition of `custom` cannot be read, or the distro does not exist.
        """
        store, definitions = store_of(distro), tuple(custom)
        is_ros1 = store is not None and store.value.startswith("ros1")
        self._resolvers = {
            1: TypeResolver(
                store if store and is_ros1 else Stores.ROS1_NOETIC,
                definitions,
                types=types,
                registry=registry,
            ),
            2: TypeResolver(
                store if store and not is_ros1 else Stores.LATEST, definitions, types=types, registry=registry
            ),
        }
        self._first, self._second = (1, 2) if is_ros1 else (2, 1)

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of a type in a version of ROS.

        Raises:
            BagError: The type is unknown in that version.
        """
        return self._resolvers[ros_version].resolve(msgtype, embedded, ros_version=ros_version)

    def find(self, msgtype: str, spec: AdapterSpec | None = None) -> Definition:
        """Return the definition of a type in either version of ROS; the text in an adapter file takes precedence.

        Raises:
            BagError: The type is unknown.
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
    """Return the mapping of an adapter, None for an adapter in Python."""
    if isinstance(spec, Builtin):
        return spec.mapping
    return spec if isinstance(spec, MappingSpec) else None


_DISTROS = (Stores.LATEST, Stores.ROS2_HUMBLE, Stores.ROS2_FOXY, Stores.ROS1_NOETIC)
"""The distros to look up the type of a dict in; the first definition that has all keys of the dict is used."""


def translate(spec: AdapterSpec, msg: ROSMessage) -> Message:
    """Return the ontology object and the time of one message.

    Raises:
        AdapterError: The message does not fit.
    """
    if isinstance(spec, PythonAdapterSpec):
        return spec.adapter.translate(msg)
    data = adapt_dict(spec, msg.data, msg.msg_type)
    return Message(timestamp_ns=msg.bag_timestamp_ns, data=data)


def adapt_dict(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> Serializable:
    """Return the ontology object for a dict of fields; among several types, the first that has all keys is used.

    Raises:
        AdapterError: A field is unknown or missing, or a value does not fit.
    """
    adapter, rows, name = _bind(spec, ros_data, msgtype)
    adapted = adapter.adapt(rows, Envelope("", name, np.zeros(1, np.int64)))
    if adapted.failures:
        raise AdapterError(f"{spec.name}: {adapted.failures[0].reason}")
    return model(adapter.ontology.tag).from_row(cast("dict[str, Any]", adapted.rows[0].as_py()))


def metadata_of(spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None = None) -> dict[str, Any]:
    """Return the topic metadata of a first message."""
    adapter, rows, _ = _bind(spec, ros_data, msgtype)
    return adapter.topic_metadata(rows[0])


def _bind(
    spec: AdapterSpec, ros_data: Mapping[str, Any], msgtype: str | None
) -> tuple[Adapter, pa.StructArray, str]:
    names = () if msgtype is None else (normalize_msgtype(msgtype),)
    problems: list[str] = []
    for definition in _candidates(spec, names):
        shape = ros_shape(definition)
        unknown = next(_unknown(ros_data, shape, ""), None)
        if unknown is None:
            return spec.bind(definition, shape), _row(ros_data, shape, spec.name), definition.root
        problems.append(f"{definition.root} has no field {unknown}")
    unknown_types = f"no distro defines {', '.join(names or spec.ros_types)}"
    raise AdapterError(f"{spec.name}: {problems[0] if problems else unknown_types}")


def _candidates(spec: AdapterSpec, names: tuple[str, ...]) -> Iterator[Definition]:
    """Yield the definitions that a dict may have: its own type in all distros, then the adapter's other types."""
    mapping = mapping_of(spec)
    for name in dict.fromkeys((*names, *spec.ros_types)):
        yield from _versions(name, mapping.own_text(name) if mapping else None)


@cache
def _versions(msgtype: str, text: str | None) -> tuple[Definition, ...]:
    """Return the definitions of a type in all distros, or in an adapter's own text."""
    definitions: list[Definition] = []
    for distro in _DISTROS:
        version = 1 if distro is Stores.ROS1_NOETIC else 2
        types = {msgtype: text} if text else None
        with suppress(BagError):
            definitions.append(TypeResolver(distro, types=types).resolve(msgtype, None, ros_version=version))
    return tuple(definitions)


def _unknown(ros_data: Mapping[str, Any], shape: pa.StructType, where: str) -> Iterator[str]:
    """Yield the keys that are not fields, including nested keys."""
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
    """A built-in adapter as a class, for overrides, single messages and subclasses."""

    __adapter_spec__: ClassVar[Builtin]

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> Serializable:
        """Return the ontology object for the fields of one message.

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
        """Return the topic metadata of a first message."""
        return metadata_of(cls.__adapter_spec__, ros_data) or None

    @classmethod
    def to_ros(
        cls,
        mosaico_data: Message | Serializable,
        typestore: Any,  # noqa: ANN401 - rosbags' class, which only `rosbag` imports
        ros_msg_type: str | None = None,
    ) -> Any:  # noqa: ANN401 - a generated class
        """Return the message object of a rosbags typestore for an ontology object; restores as the export does.

        Raises:
            AdapterError: The adapter does not take the type, or the object is of another ontology type.
            BagError: The typestore does not have the type.
        """
        msgtype = normalize_msgtype(ros_msg_type or cls.get_default_ros_msg())
        data, _ = cls.unpack_mosaico_msg(mosaico_data)
        if not cls.is_rosmsg_type_valid(msgtype) or not isinstance(data, cls.__mosaico_ontology_type__):
            raise AdapterError(
                f"{cls.__name__} does not convert {type(data).__name__} to {msgtype}",
                hint=f"it converts {cls.__mosaico_ontology_type__.__name__} to {', '.join(ros_types_of(cls))}",
            )
        definition = definition_in(typestore, msgtype)
        adapter = cls.__adapter_spec__.bind(definition, ros_shape(definition))
        row = cast("pa.StructArray", pa.array([data.to_row()], adapter.ontology.struct))
        restored = invert(adapter, definition, {}).restore(row, Envelope("", msgtype, np.zeros(1, np.int64)))
        return native_message(typestore, msgtype, cast("dict[str, Any]", restored.rows[0].as_py()))


@cache
def adapter_class(name: str) -> type[CatalogAdapter]:
    """Return the class of a built-in adapter by name; raises KeyError if there is none."""
    builtin = BY_NAME[name]
    members = {
        "__doc__": builtin.mapping.model.description,
        "__module__": __package__,
        "__adapter_spec__": builtin,
        "__mosaico_ontology_type__": model(builtin.tag),
        "ros_msgtype": builtin.ros_types,
    }
    return type(name, (CatalogAdapter,), members)
