from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording

DAMAGED = Path(__file__).parent / "data" / "damaged_rowids.db3"
"""A database found by fuzzing: the rows of a page differ from the index, so that a naive scan never advances."""
TABLE_LEAF = 13
"""First byte of a page with rows."""


def test_row_scan_rows_out_of_order_terminates() -> None:
    with open_recording(DAMAGED, resolve=TypeResolver()) as recording:
        read = sum(len(batch) for batch in recording.message_blocks())
        assert read < 1000
        assert len(recording.findings) < 100


def test_sqlite_without_time_index_with_damaged_page_reports_gap_in_row_ids(tmp_path: Path) -> None:
    path = tmp_path / "drive.db3"
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        database.execute(
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute("INSERT INTO topics VALUES (1, '/speed', 'std_msgs/msg/Float64')")
        rows = [(rowid, 1, rowid, bytes(12)) for rowid in range(1, 2001)]
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    content = bytearray(path.read_bytes())
    leaf = next(page for page in range(8192, len(content), 4096) if content[page] == TABLE_LEAF)
    content[leaf + 4] -= 1  # the number of cells
    path.write_bytes(content)
    with open_recording(path, resolve=TypeResolver()) as recording:
        assert recording.message_count is None, "the count of the damaged table is not the promised one"
        assert [finding.rule for finding in recording.findings] == ["container-note"]
        assert sum(map(len, recording.message_blocks())) == 1999
        (loss,) = recording.unreadable
        assert loss.count is None
        assert loss.reason.endswith("an unknown number of rows is missing")
