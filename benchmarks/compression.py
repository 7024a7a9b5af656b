"""Compare the size of stored sequences with the recordings and with the chunks of a Mosaico server.

A chunk holds the rows of one upload message of the official client (about 25 MB of Arrow data) in a Parquet file
with zstd and otherwise pyarrow's defaults.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

import pyarrow.parquet as pq
from measure import run

from mosaico_ingest.destinations.store.store import Store

CHUNK_BYTES = 25 << 20
ROW = "{:<22} {:>9} {:>9} {:>8} {:>10} {:>8} {:>7}"


def chunks_bytes(store: Path, folder: Path) -> int:
    """Return the total size of the stored rows as one Parquet file per chunk, in bytes."""
    total = 0
    for sequence in Store.open(store, create=False).sequences():
        for topic in sequence.topics:
            for segment in topic.segments:
                with pq.ParquetFile(segment.path) as file:
                    for number in range(file.num_row_groups):
                        group = file.read_row_group(number)
                        rows = max(1, group.num_rows * CHUNK_BYTES // max(group.nbytes, 1))
                        for start in range(0, group.num_rows, rows):
                            path = folder / "chunk.parquet"
                            pq.write_table(group.slice(start, rows), path, compression="zstd")
                            total += path.stat().st_size
    return total


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", metavar="RECORDING", nargs="+", type=Path)
    recordings = parser.parse_args().recordings
    print(ROW.format("recording", "source MB", "store MB", "saving", "chunks MB", "ratio", "time s"))
    for recording in recordings:
        with tempfile.TemporaryDirectory(dir=recording.parent) as folder:
            store, report = Path(folder) / "store", Path(folder) / "report.json"
            command = [sys.executable, "-m", "mosaico_ingest", "bag", recording, "--name", "run", "-q"]
            sample = run([*command, "--store", store, "--report", report])
            source = json.loads(report.read_text())["recordings"][0]["source_bytes"]
            store_bytes = sum(file.stat().st_size for file in store.rglob("*.parquet"))
            server_bytes = chunks_bytes(store, Path(folder))
            shutil.rmtree(store)
        source_mb, store_mb, server_mb = (f"{size / 1e6:.1f}" for size in (source, store_bytes, server_bytes))
        print(
            ROW.format(
                recording.name,
                source_mb,
                store_mb,
                f"{100 * (1 - store_bytes / source):.0f} %",
                server_mb,
                f"{store_bytes / server_bytes:.2f}",
                f"{sample.wall_s:.2f}",
            )
        )


if __name__ == "__main__":
    main()
