"""This file is what every part of a report, an inspection and a plan is: frozen, strict, and always writable as JSON."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, field_validator

from mosaico_ingest.diagnostics import encodable

__all__ = ["Part"]


class Part(BaseModel):
    """A model whose texts can be encoded, whatever the names of files hold."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @field_validator("*", mode="before")
    @classmethod
    def _encodable(cls, value: Any) -> Any:  # noqa: ANN401 - every field of every part
        if type(value) is str:
            return encodable(value)
        if isinstance(value, tuple):
            return tuple(encodable(item) if type(item) is str else item for item in value)
        return value
