"""This file is the destination's seam: a sink opens a session, a session opens topics, a topic takes batches."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import pyarrow as pa

from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.policies import IfExists

__all__ = ["ENVELOPE", "Session", "Sink", "StoredTopic", "TopicWriter"]

ENVELOPE = pa.field("timestamp_ns", pa.int64(), nullable=False)
"""The first column of every batch: when the message was recorded, ns since the epoch."""


@dataclass(frozen=True, slots=True)
class StoredTopic:
    """What the destination says it holds of one topic after the commit."""

    topic: str
    rows: int
    start_ns: int | None
    end_ns: int | None
    """The largest time stamp, inclusive."""
    stored_bytes: int


class TopicWriter(Protocol):
    """Takes the batches of one topic."""

    def write(self, batch: pa.RecordBatch) -> None:
        """Append rows: `timestamp_ns` first, then the ontology's columns.

        Raises:
            SinkError: The destination refused them; nothing of this batch is stored.
        """
        ...


class Session(Protocol):
    """One writing session of a sequence; what it wrote becomes visible at once, when it ends."""

    def topic(self, name: str, ontology: OntologyType, metadata: Mapping[str, Any]) -> TopicWriter:
        """Open a topic; once per name and session.

        Raises:
            SinkError: The destination refuses the name, the metadata or the type.
        """
        ...

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        """Attach an error to the sequence, or to one of its topics, for whoever looks at it later."""
        ...

    def stored(self) -> tuple[StoredTopic, ...]:
        """Return what the destination holds, asked from it anew; only after a commit."""
        ...


class Sink(Protocol):
    """A place sequences go to."""

    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> AbstractContextManager[Session]:
        """Open a session; leaving it normally commits, leaving it by an exception discards what it wrote.

        Raises:
            SequenceExists: The name is taken and `if_exists` is `fail`.
            SinkError: The destination refuses the name or the metadata.
        """
        ...
