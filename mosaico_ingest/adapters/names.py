"""This file makes classes of the catalog's adapters, so that Python can name, call and extend them."""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

from mosaico_ingest.adapters.base import ROSAdapterBase
from mosaico_ingest.adapters.builtin import BY_NAME, Builtin
from mosaico_ingest.adapters.single import adapt_dict, metadata_of, translate
from mosaico_ingest.bag.message import ROSMessage
from mosaico_ingest.ontology.message import Message
from mosaico_ingest.ontology.registry import model
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["CatalogAdapter", "adapter_class"]


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
