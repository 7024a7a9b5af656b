"""This file derives the JSON Schema of adapter files from their model."""

from __future__ import annotations

from functools import cache
from typing import Any

from mosaico_ingest.adapters.mapping.model import MappingFile
from mosaico_ingest.manifest.schema import DIALECT, tidy
from mosaico_ingest.model_schema import schema_of

__all__ = ["adapter_schema"]


@cache
def adapter_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) that editors complete and check adapter files with."""
    schema = tidy(schema_of(MappingFile))
    takes = [{"required": ["ros_type"]}, {"required": ["variants"]}]
    return {"$schema": DIALECT, "title": "mosaico-ingest adapter", **schema, "oneOf": takes}
