"""This file is what a Python adapter subclasses, and the list of those registered as defaults."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.errors import AdapterError

if TYPE_CHECKING:
    from mosaico_ingest.bag.message import ROSMessage
    from mosaico_ingest.ontology.message import Message
    from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["ROSAdapterBase", "register_default_adapter", "registered_adapters", "ros_types_of"]

T = TypeVar("T", bound="Serializable")
A = TypeVar("A", bound=type[Any])

_registered: dict[str, type[Any]] = {}


class ROSAdapterBase(Generic[T]):
    """Turns messages of `ros_msgtype` into objects of `__mosaico_ontology_type__`.

    An adapter fills in `from_dict`. One that also has a classmethod
    `from_batch(rows: pa.StructArray) -> pa.StructArray` is given whole batches of columns instead: as many rows of
    the ontology's columns come back, a null row is a rejected one.
    """

    ros_msgtype: str | tuple[str, ...]
    """The message types it takes, as `sensor_msgs/msg/Imu`."""
    __mosaico_ontology_type__: type[Any]
    """The class `from_dict` returns an object of."""

    @classmethod
    def from_dict(cls, ros_data: dict[str, Any]) -> T:
        """Return the object for one message, a dict of its fields; any exception rejects the message."""
        raise NotImplementedError(f"{cls.__name__} defines neither from_dict nor from_batch")

    @classmethod
    def translate(cls, ros_msg: ROSMessage, **kwargs: Any) -> Message:  # noqa: ANN401 - passed on to from_dict
        """Return the object with its time; to be overridden where the topic or the time of a message matter."""
        from mosaico_ingest.ontology.message import Message  # noqa: PLC0415 - the models are slow to import

        convert: Callable[..., T] = cls.from_dict  # one that is overridden may take more
        return Message(timestamp_ns=ros_msg.bag_timestamp_ns, data=convert(ros_msg.data, **kwargs))

    @classmethod
    def schema_metadata(
        cls,
        ros_data: dict[str, Any],  # noqa: ARG003 - for those who override it
        **kwargs: Any,  # noqa: ANN401, ARG003 - the same
    ) -> dict[str, Any] | None:
        """Return topic metadata read from the topic's first message; none by default."""
        return None


def register_default_adapter(adapter: A) -> A:
    """Make an adapter class the default for its types, before the built-in ones (a class decorator).

    Raises:
        AdapterError: Another class is already registered for one of the types.
    """
    for msgtype in ros_types_of(adapter):
        other = _registered.get(msgtype)
        if other is not None and _path(other) != _path(adapter):
            raise AdapterError(
                f"{_path(adapter)} and {_path(other)} both register as the default for {msgtype}",
                hint="register one, and name the other in adapter_override for its topics",
            )
        _registered[msgtype] = adapter
    return adapter


def registered_adapters() -> dict[str, type[Any]]:
    """Return the adapter classes registered as defaults, by message type."""
    return dict(_registered)


def ros_types_of(adapter: type[Any]) -> tuple[str, ...]:
    """Return the message types an adapter class names.

    Raises:
        AdapterError: It names none.
    """
    declared: object = getattr(adapter, "ros_msgtype", None)
    names = (declared,) if isinstance(declared, str) else declared
    if not isinstance(names, (tuple, list)) or not names or not all(isinstance(name, str) for name in names):
        raise AdapterError(
            f"{_path(adapter)} has no ros_msgtype",
            hint='set it to a type such as "my_pkg/msg/MyType", or to a tuple of them',
        )
    return tuple(normalize_msgtype(str(name)) for name in names)


def _path(adapter: type[Any]) -> str:
    return f"{adapter.__module__}.{adapter.__qualname__}"
