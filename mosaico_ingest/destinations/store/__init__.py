"""The embedded store: Arrow batches in, a catalog and Parquet segments out.

`StoreSink` writes sequences and `Store` reads them. A session becomes visible in one transaction when it is committed,
and no sequence or topic name can refer to a path outside the store. The package must not depend on recordings.
"""

from __future__ import annotations

from mosaico_ingest.destinations.store.model import (
    Collected,
    Listing,
    Note,
    SegmentInfo,
    SequenceInfo,
    SequenceSummary,
    SessionInfo,
    TopicInfo,
)
from mosaico_ingest.destinations.store.session import StoreSink
from mosaico_ingest.destinations.store.store import Store

__all__ = [
    "Collected",
    "Listing",
    "Note",
    "SegmentInfo",
    "SequenceInfo",
    "SequenceSummary",
    "SessionInfo",
    "Store",
    "StoreSink",
    "TopicInfo",
]
