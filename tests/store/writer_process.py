"""A process that writes sequences and commits them together: `python writer_process.py STORE SEQUENCE,… IF_EXISTS N`."""

from __future__ import annotations

import sys
from typing import cast

import numpy as np
import pyarrow as pa

from mosaico_ingest.destinations import Session, topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.session import StoreSession, commit_sessions
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType

SAMPLE = OntologyType("Sample", pa.struct([pa.field("value", pa.float64()), pa.field("source", pa.int32())]))
TOPICS = 4
ROWS = 2000


def main(path: str, sequences: str, if_exists: str, source: int) -> None:
    sink = StoreSink(Store.open(path), buffer_bytes=100_000, deferred=True)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sessions: list[Session] = []
    for sequence in sequences.split(","):
        with sink.open(sequence, {"source": source}, if_exists=IfExists(if_exists)) as session:
            sys.stdout.write("open\n")
            sys.stdout.flush()
            write(session, source)
        sessions.append(session)
    errors = commit_sessions(cast("list[StoreSession]", sessions))
    sys.exit(any(errors))


def write(session: Session, source: int) -> None:
    topics = [session.topic(f"/t{i}", SAMPLE, {}) for i in range(TOPICS)]
    for start in range(0, ROWS, 100):
        times = np.arange(start, start + 100, dtype=np.int64)
        columns = [pa.array(times), pa.array(times / 2), pa.array(np.full(100, source, np.int32))]
        for topic in topics:
            topic.write(pa.RecordBatch.from_arrays(columns, schema=topic_schema(SAMPLE)))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
