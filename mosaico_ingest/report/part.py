"""This file is what every part of a report, an inspection and a plan is: frozen, strict, and always writable as JSON."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

from mosaico_ingest.diagnostics import encodable

__all__ = ["Part"]


class Part(BaseModel):
    """A model whose texts can be encoded, whatever the names of files hold."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _spell_texts(cls, values: Any) -> Any:  # noqa: ANN401 - whatever stands for a part
        """Look at all fields at once: a validator for each made every part slow to build."""
        return (
            {name: _encodable(value) for name, value in values.items()}
            if isinstance(values, dict)
            else values
        )


def _encodable(value: Any) -> Any:  # noqa: ANN401 - every field of every part
    if type(value) is str:
        return encodable(value)
    if isinstance(value, tuple):
        return tuple(encodable(item) if type(item) is str else item for item in value)
    return value
