"""This file derives the JSON Schema of a report file from its model."""

from __future__ import annotations

from typing import Any

from mosaico_ingest.model_schema import schema_of
from mosaico_ingest.report.model import RunReport

__all__ = ["report_schema"]


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a report file."""
    schema = schema_of(RunReport, mode="serialization")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
