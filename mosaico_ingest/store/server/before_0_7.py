"""This file is what clients before 0.7 look for beside the rest: they find types and metadata in schemas."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from mosaico_ingest.store.model import SequenceInfo
from mosaico_ingest.store.model import TopicInfo as StoredTopicInfo
from mosaico_ingest.wire.bodies import Body, Interval, TopicInfo

__all__ = ["Extent", "OlderTopicInfo", "sequence_schema", "topic_schema"]


class Extent(Body):
    """How much a topic holds, under the older names."""

    chunks_number: int
    total_bytes: int
    timestamp: Interval | None


class OlderTopicInfo(TopicInfo):
    """A topic's application metadata, for clients of either time."""

    info: Extent


def sequence_schema(sequence: SequenceInfo) -> pa.Schema:
    """Return no columns, and what is said of the sequence."""
    return _with(pa.schema([]), {"context": "sequence", "user_metadata": sequence.metadata})


def topic_schema(topic: StoredTopicInfo) -> pa.Schema:
    """Return the topic's columns, and what is said of it."""
    properties = {
        "ontology_tag": topic.ontology.tag,
        "serialization_format": topic.ontology.serialization_format.value,
    }
    return _with(
        topic.schema, {"context": "topic", "properties": properties, "user_metadata": topic.metadata}
    )


def _with(schema: pa.Schema, said: Mapping[str, Any]) -> pa.Schema:
    spelled = {
        f"mosaico:{key}": value if isinstance(value, str) else json.dumps(value)
        for key, value in said.items()
    }
    return schema.with_metadata(spelled)
