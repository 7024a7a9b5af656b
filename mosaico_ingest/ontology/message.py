"""This file is one recorded message: when, and what."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, PlainValidator, SerializeAsAny

from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Message"]

_Model = TypeVar("_Model", bound=Serializable)


def _ontology_object(value: object) -> object:
    """Return the value as it is; the official SDK's own objects are as good as ours."""
    if not isinstance(value, BaseModel) or not hasattr(value, "ontology_tag"):
        raise ValueError(f"{type(value).__name__} is no ontology object")
    return value


class Message(BaseModel):
    """The envelope around a row."""

    model_config = ConfigDict(extra="forbid", defer_build=True)

    timestamp_ns: int
    """When it was recorded, ns since the epoch."""
    data: Annotated[SerializeAsAny[Serializable], PlainValidator(_ontology_object)]
    """The row itself."""

    def get_data(self, model: type[_Model]) -> _Model | None:
        """Return the row where it is a `model`, None otherwise."""
        return self.data if isinstance(self.data, model) else None

    def ontology_tag(self) -> str:
        """Return the tag of the row."""
        return self.data.ontology_tag()
