"""Many small appended sessions: time to read their rows and to open the sequence, before and after `ingest store compact`.

./dev bench compaction [--sessions N]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
import pyarrow as pa

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.compaction import compact
from mosaico_ingest.job.values import Compression, IfExists
from mosaico_ingest.ontology.registry import OntologyType

SAMPLE = OntologyType("Sample", pa.struct([pa.field("value", pa.float64()), pa.field("count", pa.int32())]))
ROWS = 100
ROUNDS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=1000)
    sessions: int = parser.parse_args().sessions
    with tempfile.TemporaryDirectory() as folder:
        store = Store.open(Path(folder) / "store")
        for number in range(sessions):
            with StoreSink(store).open("s", {}, if_exists=IfExists.APPEND) as session:
                session.topic("/t", SAMPLE, {}).write(rows(number))
        report("appended", store)
        for compression in (Compression.FAST, Compression.SMALL):
            start = time.perf_counter()
            results = list(compact(store, store.sequence("s"), compression=compression))
            if results:
                print(f"compact ({compression.value}): {time.perf_counter() - start:.2f} s")
                report("compacted", store)


def rows(number: int) -> pa.RecordBatch:
    times = np.arange(number * ROWS, (number + 1) * ROWS, dtype=np.int64)
    columns = [pa.array(times), pa.array(np.sin(times / 50)), pa.array((times % 7).astype(np.int32))]
    return pa.RecordBatch.from_arrays(columns, schema=topic_schema(SAMPLE))


def report(name: str, store: Store) -> None:
    opened, read = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        topic = store.topic("s", "/t")
        opened.append(time.perf_counter() - start)
        table = store.scan("s", "/t").read_all()
        read.append(time.perf_counter() - start)
    print(
        f"{name}: {len(topic.segments)} files, {table.num_rows:,} rows, {topic.stored_bytes / 1e3:.0f} kB; "
        f"open {median(opened) * 1e3:.1f} ms, read {median(read) * 1e3:.1f} ms"
    )


if __name__ == "__main__":
    main()
