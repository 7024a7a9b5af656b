from __future__ import annotations

from pathlib import Path

from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

DAMAGED = Path(__file__).parent / "data" / "damaged_rowids.db3"
"""A database found by fuzzing: the rows of a page differ from the index, so that a naive scan never advances."""


def test_row_scan_rows_out_of_order_terminates() -> None:
    with open_recording(DAMAGED, resolve=TypeResolver()) as recording:
        read = sum(len(batch) for batch in recording.message_blocks())
        assert read < 1000
        assert len(recording.findings) < 100
