"""This file derives the JSON Schema of a plan file from its model."""

from __future__ import annotations

from typing import Any

from mosaico_ingest.model_schema import schema_of
from mosaico_ingest.plan.document import PlanDocument

__all__ = ["plan_schema"]


def plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a plan file."""
    schema = schema_of(PlanDocument, mode="serialization")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
