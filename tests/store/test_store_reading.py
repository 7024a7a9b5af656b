from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import duckdb
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.session import Staging, StoreTopic
from mosaico_ingest.destinations.store.store import Window, scan
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType

Rows = Callable[..., pa.RecordBatch]

TIMES = st.lists(st.lists(st.integers(0, 60), max_size=8), max_size=6)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sessions=st.lists(TIMES, min_size=1, max_size=3),
    window=st.tuples(st.none() | st.integers(-5, 65), st.none() | st.integers(-5, 65)),
    flushed=st.integers(0, 1),
)
def test_scan_any_sessions_returns_sorted_rows_of_time_range(  # noqa: PLR0917 - fixtures and hypothesis name them
    tmp_path_factory: pytest.TempPathFactory,
    rows: Rows,
    sample: OntologyType,
    sessions: list[list[list[int]]],
    window: tuple[int | None, int | None],
    flushed: int,
) -> None:
    start, end = window
    store = Store.open(tmp_path_factory.mktemp("s"))
    written: list[int] = []
    for times in sessions:
        with StoreSink(store).open("s", {}, if_exists=IfExists.APPEND) as session:
            topic = session.topic("/t", sample, {})
            for batch in times:
                topic.write(rows(batch))
                if flushed:
                    topic.flush()
                written += batch
    expected = sorted(
        time for time in written if (start is None or time >= start) and (end is None or time < end)
    )
    assert store.scan("s", "t", start_ns=start, end_ns=end).read_all()["timestamp_ns"].to_pylist() == expected


def test_segments_of_unordered_writes_are_sorted_by_time(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("s", {}) as session:
        topic = session.topic("/t", sample, {})
        for times in ([5, 3], [7], [6, 9], [1]):
            topic.write(rows(times))
            topic.flush()
    segments = store.topic("s", "/t").segments
    actual = [ds.dataset(segment.path).to_table()["timestamp_ns"].to_pylist() for segment in segments]
    assert actual == [[1], [3, 5, 7], [6, 9]]
    assert [(segment.start_ns, segment.end_ns) for segment in segments] == [(1, 1), (3, 7), (6, 9)]


def test_scan_with_columns_returns_timestamp_and_those_columns(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("s", {}) as session:
        session.topic("/t", sample, {}).write(rows([1, 2]))
    assert store.scan("s", "t", columns=["source"]).read_all().column_names == ["timestamp_ns", "source"]
    with pytest.raises(SinkError, match=r"no column 'x'.*value"):
        store.scan("s", "t", columns=["x"])


def test_unknown_sequence_or_topic_raises_with_existing_names(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        session.topic("/imu", sample, {}).write(rows([1]))
    with pytest.raises(SinkError, match=r"no sequence 'dive'.*drive"):
        store.sequence("dive")
    with pytest.raises(SinkError, match=r"no topic '/gps'.*/imu"):
        store.topic("drive", "gps")


def test_topic_files_are_readable_by_duckdb_polars_and_glob(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    with sink.open("drive", {}) as session:
        session.topic("/front/imu", sample, {}).write(rows(range(100)))
        session.topic("/front", sample, {}).write(rows(range(5)))
    pattern = str(store.path / "segments/drive/front/imu/*.parquet")
    assert duckdb.sql(f"select count(*), max(value) from '{pattern}'").fetchall() == [(100, 49.5)]  # noqa: S608 - the path is the test's own
    assert pl.scan_parquet(pattern).select(pl.len()).collect().item() == 100
    assert store.paths("drive", "front/imu") == tuple(store.path.glob("segments/drive/front/imu/*.parquet"))


def test_ontology_type_round_trip_keeps_names_and_nullability(sink: StoreSink, store: Store) -> None:
    inner = pa.struct([pa.field("x", pa.float32(), nullable=False), pa.field("label", pa.string())])
    odd = OntologyType(
        "Odd",
        pa.struct(
            [
                pa.field("boxes", pa.list_(pa.field("box", inner, nullable=False)), nullable=False),
                pa.field("matrix", pa.list_(pa.field("item", pa.float64(), nullable=False), 9)),
                pa.field("blob", pa.large_binary()),
                pa.field("text", pa.large_string()),
                pa.field("nothing", pa.null()),
                pa.field("tiny", pa.int8()),
            ]
        ),
    )
    row = {
        "timestamp_ns": 1,
        "boxes": [{"x": 1.0, "label": None}],
        "matrix": [0.0] * 9,
        "blob": b"\0" * 10,
        "text": "",
        "nothing": None,
        "tiny": -1,
    }
    with sink.open("s", {}) as session:
        topic = session.topic("/t", odd, {})
        topic.write(pa.RecordBatch.from_pylist([row], topic.schema))
    reader = store.scan("s", "t")
    assert store.topic("s", "t").ontology.fingerprint == odd.fingerprint
    assert str(reader.schema) == str(topic.schema)
    assert reader.read_all().to_pylist() == [row]


def test_topic_of_type_unsupported_by_parquet_raises_on_creation(sink: StoreSink) -> None:
    empty = OntologyType("Empty", pa.struct([pa.field("nothing", pa.struct([]))]))
    twice = OntologyType("Twice", pa.struct([pa.field("a", pa.int8()), pa.field("a", pa.int8())]))
    with sink.open("s", {}) as session:
        for ontology in (empty, twice):
            with pytest.raises(SinkError, match="/t"):
                session.topic("/t", ontology, {})


def test_staging_buffered_bytes_stay_within_limit(tmp_path: Path, rows: Rows, sample: OntologyType) -> None:
    staging = Staging(tmp_path, lambda _, number: tmp_path / f"{number}.parquet", buffer_bytes=100_000)
    topics = [StoreTopic(staging, f"/{i}", sample, "{}", folder=tmp_path) for i in range(5)]
    staging.topics = {topic.name: topic for topic in topics}
    for step in range(200):
        topics[step % 5].write(rows(np.arange(100) + step * 100))
        assert sum(topic.buffered_bytes for topic in topics) <= 100_000
    for topic in topics:
        topic.close()
    assert sum(segment.rows for topic in topics for segment in topic.segments) == 20_000


def test_scan_of_interleaved_segments_returns_limited_sorted_batches(
    sink: StoreSink, store: Store, rows: Rows, sample: OntologyType
) -> None:
    for source in range(3):
        with sink.open("s", {}, if_exists=IfExists.APPEND) as session:
            session.topic("/t", sample, {}).write(rows(np.arange(source, 600_000, 3), source))
    info = store.topic("s", "t")
    sizes, times = [], []
    for batch in scan(info.segments, info.schema, Window()):
        sizes.append(batch.num_rows)
        times.append(batch.column(0).to_numpy())
    assert max(sizes) <= 1 << 16
    assert np.array_equal(np.concatenate(times), np.arange(600_000))
