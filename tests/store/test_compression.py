"""`target.compression`: both choices store the same rows, and `small` needs fewer bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_messages import random_rows

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.store import verify
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.model import DestinationSettings
from mosaico_ingest.job.values import Compression, StoreTarget
from mosaico_ingest.ontology.registry import OntologyType

ROWS = 20_000


def columns() -> dict[str, pa.Array[Any]]:
    """Return one column for each encoding, which makes it smallest."""
    random = np.random.default_rng(1)
    at = np.arange(ROWS)
    return {
        "constant": pa.array(np.full(ROWS, 0.01)),
        "noise": pa.array(random.standard_normal(ROWS)),
        "quantized": pa.array(random.integers(0, 200, ROWS) * 0.1),
        "counter": pa.array((1 << 33) + at),
        "stamps": pa.array((at * 20_000_000 + random.integers(0, 900, ROWS)).astype(np.uint64)),
        "names": pa.array([f"vehicle/part_{each:07}/temperature" for each in at]),
        "states": pa.array(random.choice(["idle", "drive", "charge"], ROWS)),
        "flags": pa.array(random.integers(0, 2, ROWS).astype(bool)),
        "small": pa.array(random.integers(0, 9, ROWS).astype(np.int16)),
        "lists": pa.array([[float(each), float(each % 7)] for each in at]),
    }


def batch(ontology: OntologyType, arrays: dict[str, pa.Array[Any]]) -> pa.RecordBatch:
    length = len(next(iter(arrays.values())))
    return pa.RecordBatch.from_arrays(
        [pa.array(np.arange(length)), *arrays.values()], schema=topic_schema(ontology)
    )


def stored(folder: Path, ontology: OntologyType, rows: pa.RecordBatch, compression: Compression) -> Store:
    store = Store.open(folder / compression.value)
    with StoreSink(store, compression=compression).open("s", {}) as session:
        session.topic("/t", ontology, {}).write(rows)
    return store


def test_small_stores_same_rows_and_checksum_in_fewer_bytes(tmp_path: Path) -> None:
    arrays = columns()
    ontology = OntologyType("T", pa.struct([pa.field(name, each.type) for name, each in arrays.items()]))
    rows = batch(ontology, arrays)
    fast, small = (stored(tmp_path, ontology, rows, each).topic("s", "/t") for each in Compression)
    assert small.stored_bytes < 0.6 * fast.stored_bytes
    assert small.checksum == fast.checksum
    assert small.to_arrow().equals(fast.to_arrow())
    info = Store.open(tmp_path / "small").sequence("s")
    assert [each.problem for each in verify(info)] == [None]
    group = pq.read_metadata(small.segments[0].path).row_group(0)
    encodings = {
        group.column(number).path_in_schema: group.column(number).encodings
        for number in range(group.num_columns)
    }
    assert "DELTA_BINARY_PACKED" in encodings["counter"]
    assert "BYTE_STREAM_SPLIT" in encodings["noise"]
    assert "RLE_DICTIONARY" in encodings["quantized"]
    assert "DELTA_BYTE_ARRAY" in encodings["names"]


def test_small_files_are_readable_by_duckdb_and_polars(tmp_path: Path) -> None:
    arrays = columns()
    ontology = OntologyType("T", pa.struct([pa.field(name, each.type) for name, each in arrays.items()]))
    topic = stored(tmp_path, ontology, batch(ontology, arrays), Compression.SMALL).topic("s", "/t")
    (path,) = (segment.path for segment in topic.segments)
    expected = pa.table(arrays)
    names = ", ".join(arrays)
    table = duckdb.sql(f"SELECT {names} FROM '{path}' ORDER BY timestamp_ns").to_arrow_table()  # noqa: S608 - our own names
    assert table.to_pydict() == expected.to_pydict()
    assert pl.read_parquet(path).select(*arrays).to_arrow().to_pydict() == expected.to_pydict()


TYPES = st.sampled_from([
    pa.float64(), pa.float32(), pa.float16(), pa.bool_(), pa.int8(), pa.uint16(), pa.int32(), pa.uint32(), pa.int64(), pa.uint64(),
    pa.string(), pa.binary(), pa.list_(pa.int64()), pa.list_(pa.string()),
    pa.struct([pa.field("a", pa.int32()), pa.field("b", pa.list_(pa.uint8()))]),
])  # fmt: skip


@settings(max_examples=6, deadline=None)
@given(
    kinds=st.lists(TYPES, min_size=1, max_size=4), count=st.sampled_from([1, 40, 700]), seed=st.integers(0, 9)
)
def test_small_writes_rows_of_any_type(
    tmp_path_factory: pytest.TempPathFactory, kinds: list[pa.DataType], count: int, seed: int
) -> None:
    struct = pa.struct([pa.field(f"c{number}", kind) for number, kind in enumerate(kinds)])
    values = random_rows(struct, count, seed=seed)
    ontology = OntologyType("T", struct)
    arrays = {field.name: values.field(field.name) for field in struct}
    folder = tmp_path_factory.mktemp("any")
    rows = batch(ontology, arrays)
    small = stored(folder, ontology, rows, Compression.SMALL).topic("s", "/t")
    assert repr(small.to_arrow().to_pylist()) == repr(rows.to_pylist())  # NaN differs from itself


def test_manifest_selects_compression_of_store() -> None:
    assert DestinationSettings(store="s", compression=Compression.SMALL).target(Path()) == StoreTarget(
        Path("s"), Compression.SMALL
    )
    assert DestinationSettings().target(Path()) == StoreTarget(Path("mosaico"))


@pytest.mark.parametrize("other", [{"host": "h"}, {"type": "lake"}])
def test_manifest_compression_of_another_destination_is_refused(other: dict[str, str]) -> None:
    with pytest.raises((ManifestError, ValueError), match="compression is an option of store"):
        DestinationSettings.model_validate({"compression": "small", **other})
