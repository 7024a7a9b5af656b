"""A lower bound for ingestion: read and decompress every chunk, then write prepared tables of the same rows.

Usage: floor.py RECORDING STORE. STORE must contain the rows of the recording. The output contains the seconds that loading
them took, so that the caller can subtract them.
"""

from __future__ import annotations

import json
import sqlite3
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard

from mosaico_ingest.destinations.store.segment import Columns, SegmentWriter
from mosaico_ingest.destinations.store.store import Store

DECOMPRESS = {
    "": bytes,
    "none": bytes,
    "lz4": lz4.frame.decompress,
    "zstd": zstandard.ZstdDecompressor().decompress,
}


def mcap_chunks(path: Path) -> Iterator[bytes]:
    chunk = 6
    with path.open("rb") as file:
        file.seek(8)
        while len(head := file.read(9)) == struct.calcsize("<BQ"):
            op, length = struct.unpack("<BQ", head)
            if op != chunk:
                file.seek(length, 1)
                continue
            body = memoryview(file.read(length))
            (name_bytes,) = struct.unpack_from("<I", body, 28)
            name = bytes(body[32 : 32 + name_bytes]).decode()
            yield DECOMPRESS[name](body[40 + name_bytes :])


def ros1_chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.readline()
        while size := file.read(4):
            header = file.read(*struct.unpack("<I", size))
            (length,) = struct.unpack("<I", file.read(4))
            if b"op=\x05" not in header:
                file.seek(length, 1)
                continue
            name = header.partition(b"compression=")[2]
            kind = next(kind for kind in ("lz4", "none") if name.startswith(kind.encode()))
            yield DECOMPRESS[kind](file.read(length))


def sqlite_rows(path: Path) -> Iterator[bytes]:
    with sqlite3.connect(path) as db:
        yield from (row[0] for row in db.execute("SELECT data FROM messages"))


READERS = {".mcap": mcap_chunks, ".bag": ros1_chunks, ".db3": sqlite_rows}


def load_tables(store: Path) -> list[list[pa.Table]]:
    """Return the row groups of every segment of a store."""
    files: list[list[pa.Table]] = []
    for sequence in Store.open(store, create=False).sequences():
        for topic in sequence.topics:
            for segment in topic.segments:
                with pq.ParquetFile(segment.path) as file:
                    groups = [file.read_row_group(number) for number in range(file.num_row_groups)]
                files.append([pa.Table.from_arrays(group.columns, schema=topic.schema) for group in groups])
    return files


def main() -> None:
    recording, store = map(Path, sys.argv[1:])
    start = time.perf_counter()
    files = load_tables(store)
    read_from = time.perf_counter()
    decompressed = sum(map(len, READERS[recording.suffix](recording)))
    write_from = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=store.parent) as folder:
        for number, groups in enumerate(files):
            writer = SegmentWriter(Path(folder) / f"{number}.parquet", Columns(groups[0].schema), groups[0])
            for group in groups:
                writer.append(group)
            writer.close()
        end = time.perf_counter()
    seconds = {"load_s": read_from - start, "read_s": write_from - read_from, "write_s": end - write_from}
    print(json.dumps({**seconds, "decompressed_bytes": decompressed}))


if __name__ == "__main__":
    main()
