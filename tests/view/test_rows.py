"""Selected rows equal those of the complete table, also with overlapping files."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink, TopicInfo
from mosaico_ingest.job.values import IfExists
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.view import rows as view_rows
from mosaico_ingest.view.rows import first_rows, last_rows, nearest_row, rows_near, sampled_rows

KIND = OntologyType("Number", pa.struct([("value", pa.int64()), ("other", pa.int64())]))
SESSIONS = ([0, 10, 20, 20, 30, 90], [15, 20, 40, 41], [100, 110, 120])
TIMES = sorted(time for times in SESSIONS for time in times)


@pytest.fixture(scope="module")
def topic(tmp_path_factory: pytest.TempPathFactory) -> TopicInfo:
    """A topic of three files whose times overlap, each with row groups of two rows."""
    store = Store.open(tmp_path_factory.mktemp("rows"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mosaico_ingest.destinations.store.session._GROUP_ROWS", 2)
        for number, times in enumerate(SESSIONS):
            with StoreSink(store).open("s", {}, if_exists=IfExists.APPEND) as session:
                writer = session.topic("/t", KIND, {})
                for start in range(0, len(times), 2):
                    part = times[start : start + 2]
                    columns = [pa.array(part), pa.array(part), pa.array([number] * len(part))]
                    writer.write(pa.record_batch(columns, schema=topic_schema(KIND)))
    info = store.topic("s", "/t")
    assert len(info.segments) == 3
    assert len(list(view_rows._row_groups(info.segments))) == 7
    return info


def times_of(table: pa.Table) -> list[int]:
    return table.column("timestamp_ns").to_pylist()


@given(count=st.integers(0, 20), bound=st.none() | st.integers(-5, 130))
def test_first_rows_and_last_rows_equal_slices_of_all_rows(
    topic: TopicInfo, count: int, bound: int | None
) -> None:
    after = [time for time in TIMES if bound is None or time >= bound]
    before = [time for time in TIMES if bound is None or time <= bound]
    assert times_of(first_rows(topic, count, start_ns=bound)) == after[:count]
    assert times_of(last_rows(topic, count, end_ns=bound)) == before[max(0, len(before) - count) :]


@given(times=st.lists(st.integers(-20, 150), max_size=4))
def test_rows_near_returns_nearest_row_of_each_time(topic: TopicInfo, times: list[int]) -> None:
    expected = {min(TIMES, key=lambda time: (abs(time - at), time)) for at in times}
    assert times_of(rows_near(topic, times)) == sorted(expected)


@given(count=st.integers(1, 20))
def test_sampled_rows_include_first_and_last(topic: TopicInfo, count: int) -> None:
    sample = times_of(sampled_rows(topic, count))
    assert len(sample) == min(count, len(TIMES))
    assert sample[0] == 0
    assert sample == sorted(sample)
    assert count == 1 or sample[-1] == 120


def test_nearest_row_selects_columns_and_defaults_to_first_row(topic: TopicInfo) -> None:
    assert nearest_row(topic, 39, columns=["value"]) == {"timestamp_ns": 40, "value": 40}
    assert nearest_row(topic) == {"timestamp_ns": 0, "value": 0, "other": 0}


def test_rows_of_empty_topic_are_empty(tmp_path: Path) -> None:
    store = Store.open(tmp_path)
    with StoreSink(store).open("s", {}) as session:
        session.topic("/t", KIND, {})
    topic = store.topic("s", "/t")
    assert nearest_row(topic, 5) is None
    assert nearest_row(topic) is None
    for table in (first_rows(topic, 3), last_rows(topic, 3), sampled_rows(topic, 3), rows_near(topic, [1])):
        assert table.num_rows == 0
        assert table.schema.names == topic.schema.names


def test_rows_read_only_the_row_groups_that_they_need(
    topic: TopicInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    original = view_rows._read
    monkeypatch.setattr(
        view_rows, "_read", lambda group, schema: read.append(group.number) or original(group, schema)
    )
    assert nearest_row(topic, 119, columns=[]) == {"timestamp_ns": 120}
    assert read == [1]
