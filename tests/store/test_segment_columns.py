from __future__ import annotations

import json
import os
import sqlite3
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.segment import Columns, SegmentWriter
from mosaico_ingest.ontology.registry import OntologyType

ROWS = 400
BLOB = pa.struct([pa.field("data", pa.binary())])
NOISE = np.random.default_rng(7).bytes(3000 * ROWS)


BLOBS = {
    "packed": [NOISE[i : i + 3000] for i in range(0, 3000 * ROWS, 3000)],
    "loose": [bytes(3000)] * ROWS,
}


def written(path: Path, name: str, values: pa.Array) -> pq.ColumnChunkMetaData:
    times = pa.array(np.arange(len(values)))
    schema = topic_schema(OntologyType("T", pa.struct([pa.field(name, values.type)])))
    table = pa.table([times, values], schema=schema)
    writer = SegmentWriter(path / "s.parquet", Columns(schema), table)
    writer.append(table)
    writer.close()
    assert pq.read_table(path / "s.parquet").equals(table)
    return pq.read_metadata(path / "s.parquet").row_group(0).column(1)


@pytest.mark.parametrize(("kind", "codec"), [("packed", "UNCOMPRESSED"), ("loose", "ZSTD")])
@pytest.mark.parametrize("shape", ["binary", "large binary", "bytes in a list", "binary in a struct"])
def test_segment_blobs_are_compressed_only_if_compressible(
    tmp_path: Path, shape: str, kind: str, codec: str
) -> None:
    blobs = BLOBS[kind]
    values = {
        "binary": lambda: pa.array(blobs),
        "large binary": lambda: pa.array(blobs, pa.large_binary()),
        "bytes in a list": lambda: pa.array([list(each) for each in blobs], pa.list_(pa.uint8())),
        "binary in a struct": lambda: pa.array([{"a": each} for each in blobs]),
    }[shape]()
    chunk = written(tmp_path, "data", values)
    assert chunk.compression == codec
    assert chunk.statistics is None or not chunk.statistics.has_min_max


@pytest.mark.parametrize("knows_how", [True, False])
def test_segment_large_file_is_flushed_while_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, knows_how: bool
) -> None:
    sent: list[tuple[int, int]] = []
    if knows_how:
        monkeypatch.setattr(
            os, "posix_fadvise", lambda _fd, begin, size, _how: sent.append((begin, size)), raising=False
        )
        monkeypatch.setattr(os, "POSIX_FADV_DONTNEED", 4, raising=False)
    else:
        monkeypatch.delattr(os, "posix_fadvise", raising=False)
    values = pa.array([NOISE] * 4)
    table = pa.table([pa.array(np.arange(4)), values], schema=topic_schema(OntologyType("T", BLOB)))
    writer = SegmentWriter(tmp_path / "s.parquet", Columns(table.schema), table)
    for _ in range(4):
        writer.append(table)
    size = writer.close().stored_bytes
    assert pq.read_table(tmp_path / "s.parquet").num_rows == 16
    ends = [begin + length for begin, length in sent]
    assert [begin for begin, _ in sent] == [0, *ends][
        : len(sent)
    ]  # each range starts at the end of the previous one
    assert (size - ends[-1] < 5 << 20 and len(sent) > 1) if knows_how else not sent


def test_segment_floats_use_byte_stream_split_and_text_a_dictionary(tmp_path: Path) -> None:
    floats = written(tmp_path, "x", pa.array(np.arange(ROWS) / 3))
    assert floats.compression == "ZSTD"
    assert "BYTE_STREAM_SPLIT" in floats.encodings
    assert not floats.has_dictionary_page
    assert written(tmp_path, "s", pa.array(["base_link"] * ROWS)).has_dictionary_page
    assert not written(tmp_path, "i", pa.array(np.arange(ROWS))).has_dictionary_page


def test_segment_all_null_column_and_dotted_name_round_trip(tmp_path: Path) -> None:
    written(tmp_path, "data", pa.array([None] * ROWS, pa.binary()))
    written(tmp_path, "da.ta", pa.array([b"x" * 4000] * ROWS))


def test_catalog_bounds_cover_columns_with_exact_bounds_only(store: Store, sink: StoreSink) -> None:
    pose = pa.struct([pa.field("x", pa.float64()), pa.field("tags", pa.list_(pa.string()))])
    kind = OntologyType(
        "T",
        pa.struct(
            [
                pa.field("pose", pose),
                pa.field("big", pa.uint64()),
                pa.field("ok", pa.bool_()),
                pa.field("raw", pa.binary()),
            ]
        ),
    )
    rows = [
        {
            "timestamp_ns": 3,
            "pose": {"x": -0.5, "tags": ["b", "a"]},
            "big": 2**64 - 1,
            "ok": True,
            "raw": b"a",
        },
        {"timestamp_ns": 4, "pose": {"x": float("nan"), "tags": []}, "big": 0, "ok": False, "raw": b"b"},
        {
            "timestamp_ns": 5,
            "pose": {"x": float("inf"), "tags": ["c" * 300]},
            "big": 0,
            "ok": False,
            "raw": None,
        },
    ]
    with sink.open("s", {}) as session:
        topic = session.topic("/t", kind, {})
        topic.write(pa.RecordBatch.from_pylist(rows, topic.schema))
    with sqlite3.connect(store.layout.catalog) as db:
        actual = {
            path: (low, high) for path, low, high in db.execute("SELECT column_path, low, high FROM bounds")
        }
    db.close()
    assert actual == {"timestamp_ns": (3, 5), "pose.x": (-0.5, float("inf")), "ok": (0, 1)}
    assert json.dumps(list(actual)) == '["ok", "pose.x", "timestamp_ns"]'
