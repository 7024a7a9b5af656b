"""The embedded store: a SQLite catalog over Parquet segments.

Batches go in through `StoreSink`, sequences come out of `Store`; nothing is visible before its session
is committed, and no name leads out of the folder.
"""

from __future__ import annotations

from mosaico_ingest.destinations.store.model import (
    Collected,
    Note,
    SegmentInfo,
    SequenceInfo,
    SessionInfo,
    TopicInfo,
)
from mosaico_ingest.destinations.store.session import StoreSink
from mosaico_ingest.destinations.store.store import Store

__all__ = [
    "Collected",
    "Note",
    "SegmentInfo",
    "SequenceInfo",
    "SessionInfo",
    "Store",
    "StoreSink",
    "TopicInfo",
]
