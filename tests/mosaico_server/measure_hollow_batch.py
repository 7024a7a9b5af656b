"""Measure a batch without offsets, unchanged or validated; the unchanged batch crashes the process."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pyarrow as pa

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from hollow_batches import hollow_batch

from mosaico_ingest.destinations import validated

schema = pa.schema([("timestamp_ns", pa.int64()), ("a", pa.list_(pa.list_(pa.list_(pa.int8()))))])
stream = io.BytesIO()
with pa.ipc.new_stream(stream, schema) as writer:
    writer.write_batch(hollow_batch(schema, 2))
batch = pa.ipc.open_stream(stream.getvalue()).read_next_batch()
_ = (validated(batch) if sys.argv[1] == "validated" else batch).nbytes
