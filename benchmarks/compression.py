"""How much smaller recordings get, and against one Parquet file a batch, as the platform keeps its chunks.

The chunks hold the same rows, as many at a time as the official client sends
(about 25 MB of Arrow data), in Parquet files with zstd and pyarrow's other defaults.
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
    """Return the size of the same rows as one Parquet file a chunk."""
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
    print(ROW.format("recording", "source MB", "store MB", "saved", "chunks MB", "ours/it", "time s"))
    for recording in recordings:
        with tempfile.TemporaryDirectory(dir=recording.parent) as folder:
            store, report = Path(folder) / "store", Path(folder) / "report.json"
            command = [sys.executable, "-m", "mosaico_ingest", "bag", recording, "--name", "run", "-q"]
            sample = run([*command, "--store", store, "--report", report])
            source = json.loads(report.read_text())["recordings"][0]["source_bytes"]
            ours = sum(file.stat().st_size for file in store.rglob("*.parquet"))
            theirs = chunks_bytes(store, Path(folder))
            shutil.rmtree(store)
        megabytes = (f"{size / 1e6:.1f}" for size in (source, ours, theirs))
        first, second, third = megabytes
        print(
            ROW.format(
                recording.name,
                first,
                second,
                f"{100 * (1 - ours / source):.0f} %",
                third,
                f"{ours / theirs:.2f}",
                f"{sample.wall_s:.2f}",
            )
        )


if __name__ == "__main__":
    main()
