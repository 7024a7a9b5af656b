"""References to adapters in manifests."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from mosaico_ingest.job.fields import AdapterRef
from mosaico_ingest.job.section import Section, Text, shape_of

AdapterReference = Annotated[Any, AdapterRef()]
"""An adapter: in manifests a text, in Python also a class or an `AdapterSpec`."""
ParameterValue = bool | int | float | str | None


class ParameterizedAdapter(Section):
    """An adapter file with values of its parameters."""

    file: AdapterReference
    """The path of the adapter file."""
    values: dict[Text, ParameterValue] = Field(alias="with", examples=[{"cells": 12}])
    """Parameter → value; parameters that are not listed have the default that the file declares."""

    def __str__(self) -> str:
        """Return the path of the file."""
        return str(self.file)


LoadedAdapter = Annotated[
    Annotated[AdapterReference, Tag("one")] | Annotated[ParameterizedAdapter, Tag("several")],
    Discriminator(shape_of),
]
"""An adapter, with or without values of its parameters."""


def reference_of(adapter: object) -> Any:  # noqa: ANN401 - what `AdapterReference` accepts
    """Return the reference of an entry in `adapters.load`."""
    return adapter.file if isinstance(adapter, ParameterizedAdapter) else adapter
