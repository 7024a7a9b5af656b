"""A process that writes one sequence until it completes or is killed: `python writer_process.py STORE SEQUENCE IF_EXISTS N`."""

from __future__ import annotations

import sys

import numpy as np
import pyarrow as pa

from mosaico_ingest.destinations.base import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.types import OntologyType

SAMPLE = OntologyType("Sample", pa.struct([pa.field("value", pa.float64()), pa.field("source", pa.int32())]))
TOPICS = 4
ROWS = 2000


def main(path: str, sequence: str, if_exists: str, source: int) -> None:
    sink = StoreSink(Store.open(path), buffer_bytes=100_000)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    with sink.open(sequence, {"source": source}, if_exists=IfExists(if_exists)) as session:
        sys.stdout.write("open\n")
        sys.stdout.flush()
        topics = [session.topic(f"/t{i}", SAMPLE, {}) for i in range(TOPICS)]
        for start in range(0, ROWS, 100):
            times = np.arange(start, start + 100, dtype=np.int64)
            columns = [pa.array(times), pa.array(times / 2), pa.array(np.full(100, source, np.int32))]
            for topic in topics:
                topic.write(pa.RecordBatch.from_arrays(columns, schema=topic_schema(SAMPLE)))
    sys.stdout.write("done\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
