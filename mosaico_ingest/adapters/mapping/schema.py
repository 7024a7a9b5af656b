"""This file derives the JSON Schema of adapter files from their model."""

from __future__ import annotations

from functools import cache
from typing import Any

from mosaico_ingest.adapters.mapping.model import MappingFile

__all__ = ["adapter_schema"]


@cache
def adapter_schema() -> dict[str, Any]:
    """Return the schema (draft 2020-12) that editors complete and check adapter files with."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {
        "$schema": dialect,
        **MappingFile.model_json_schema(by_alias=True),
        "title": "mosaico-ingest adapter",
    }
