"""Queries return exactly the topics whose rows match in a scan."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from flight_calls import Client, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.protocol.messages import Query
from mosaico_ingest.serve import Server
from mosaico_ingest.serve.query import Glob, run

Rows = Callable[..., pa.RecordBatch]

POSE = OntologyType(
    "Pose",
    pa.struct(
        [
            pa.field("at", pa.struct([pa.field("x", pa.float64()), pa.field("zone", pa.string())])),
            pa.field("ok", pa.bool_()),
            pa.field("path", pa.list_(pa.int32())),
        ]
    ),
)
FIX = OntologyType("Fix", pa.struct([pa.field("status", pa.uint8())]))


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Two drives with poses in several segments; only the first has a fix above 1."""
    store = Store.open(tmp_path_factory.mktemp("filled"))
    for number, (name, metadata) in enumerate(
        {"drive_1": {"car": {"id": 7}}, "drive_2": {"wet": True}}.items()
    ):
        with StoreSink(store).open(name, metadata) as session:
            pose = session.topic("/front/pose", POSE, {"rate": 10 * number})
            for start in (0, 100, 200):
                pose.write(poses(range(start, start + 100), 1000 * number))
                pose.close()
            fix = session.topic("/fix", FIX, {})
            fix.write(
                pa.RecordBatch.from_pylist([{"timestamp_ns": 5, "status": 2 - number}], schema=fix.schema)
            )
            session.topic("/empty", POSE, {})
    return store


def poses(times: range, offset: int) -> pa.RecordBatch:
    rows = [
        {
            "timestamp_ns": time,
            "at": None if time % 50 == 49 else {"x": float(time + offset), "zone": f"zone {time // 100}"},
            "ok": time % 2 == 0,
            "path": [time],
        }
        for time in times
    ]
    schema = pa.schema([pa.field("timestamp_ns", pa.int64(), nullable=False), *POSE.struct])
    return pa.RecordBatch.from_pylist(rows, schema)


def found(store: Store, **question: Any) -> dict[str, tuple[int, int] | None]:
    items = run(store, Query(**question)).items
    return {topic.locator: topic.timestamp_range for item in items for topic in item.topics}


POSES = ["drive_1/front/pose", "drive_2/front/pose"]
ALL = [f"{drive}/{topic}" for drive in ("drive_1", "drive_2") for topic in ("empty", "fix", "front/pose")]


@pytest.mark.parametrize(
    ("question", "locators"),
    [
        ({}, ALL),
        ({"sequence": {"name": {"$eq": "drive_1"}}}, ALL[:3]),
        ({"sequence": {"name": {"$match": "drive_#"}}}, ALL),
        ({"sequence": {"name": {"$in": ["drive_2", "other"]}}}, ALL[3:]),
        ({"sequence": {"user_metadata": {"car.id": {"$eq": 7}}}}, ALL[:3]),
        ({"sequence": {"user_metadata": {"car.id": {"$eq": "7"}}}}, []),
        ({"sequence": {"user_metadata": {"car.id": {"$ex": None}}}}, ALL[:3]),
        ({"sequence": {"user_metadata": {"car.id": {"$nex": None}}}}, ALL[3:]),
        ({"sequence": {"created_at_ns": {"$lt": 5}}}, []),
        ({"topic": {"name": {"$eq": "/front/pose"}}}, POSES),
        ({"topic": {"name": {"$eq": "front/pose"}}}, POSES),
        ({"topic": {"name": {"$match": "*pose"}}}, POSES),
        ({"topic": {"locator": {"$eq": "/front/pose"}}}, POSES),
        ({"topic": {"locator": {"$in": ["/front/pose", "drive_1/fix"]}}}, [ALL[1], *POSES]),
        ({"topic": {"locator": {"$match": "_2/front"}}}, POSES[1:]),
        ({"topic": {"name": {"$neq": "/front/pose"}, "ontology_tag": {"$eq": "Pose"}}}, [ALL[0], ALL[3]]),
        ({"topic": {"user_metadata": {"rate": {"$between": [5, 15]}}}}, POSES[1:]),
        ({"topic": {"serialization_format": {"$eq": "default"}}}, ALL),
        ({"ontology": {"Pose.at.x": {"$gt": 299.0}}}, POSES[1:]),
        ({"ontology": {"Pose.at.x": {"$lt": 0}}}, []),
        ({"ontology": {"Pose.at.x": {"$outside": [0, 1500]}}}, []),
        ({"ontology": {"Pose.at.x": {"$in": [5.0, 7]}}}, POSES[:1]),
        ({"ontology": {"Pose.at.zone": {"$match": "zone [2]"}, "Pose.ok": {"$eq": True}}}, POSES),
        ({"ontology": {"Pose.at.zone": {"$match": "z*e*#"}}}, POSES),
        ({"ontology": {"Pose.at.x": {"$eq": 5}, "Pose.ok": {"$eq": True}}}, []),
        ({"ontology": {"Pose.at": {"$nex": None}}}, POSES),
        ({"ontology": {"Pose.gone": {"$ex": None}}}, []),
        ({"ontology": {"Pose.gone": {"$nex": None}}}, POSES),
        ({"ontology": {"Pose.timestamp_ns": {"$geq": 300}}}, []),
        ({"ontology": {"Fix.status": {"$gt": 1}}}, ["drive_1/fix"]),
        (
            {"ontology": {"Fix.status": {"$gt": 1}, "Pose.at.x": {"$geq": 0}}},
            ["drive_1/fix", "drive_1/front/pose"],
        ),
        ({"ontology": {"Fix.status": {"$gt": 1}}, "sequence": {"name": {"$eq": "drive_2"}}}, []),
        ({"ontology": {"Nothing.x": {"$eq": 1}}}, []),
    ],
    ids=str,
)
def test_query_returns_topics_that_match_all_conditions(
    filled: Store, question: Mapping[str, Any], locators: list[str]
) -> None:
    assert sorted(found(filled, **question)) == sorted(locators)


SPANS = {"$gt": operator.gt, "$geq": operator.ge, "$lt": operator.lt, "$leq": operator.le, "$eq": operator.eq}


@settings(max_examples=40, deadline=None)
@given(name=st.sampled_from(sorted(SPANS)), bound=st.integers(-10, 1310), even=st.booleans())
def test_query_time_range_equals_that_of_matching_rows_in_scan(
    filled: Store,
    name: str,
    bound: int,
    even: bool,  # noqa: FBT001 - hypothesis gives it by name
) -> None:
    expected: dict[str, tuple[int, int]] = {}
    for drive in ("drive_1", "drive_2"):
        rows = filled.scan(drive, "/front/pose").read_all().to_pylist()
        fits = [
            row["timestamp_ns"]
            for row in rows
            if row["at"] and SPANS[name](row["at"]["x"], bound) and row["ok"] is even
        ]
        if fits:
            expected[f"{drive}/front/pose"] = (min(fits), max(fits))
    ontology = {"Pose.at.x": {name: bound}, "Pose.ok": {"$eq": even}, "include_timestamp_range": True}
    assert found(filled, ontology=ontology) == expected


STAMP = 1_700_000_000_123_456_789
COUNTS = (0, 2**53 + 1, 2**63, 2**64 - 1, None)
COUNTER = OntologyType("Counter", pa.struct([pa.field("count", pa.uint64())]))


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A topic for each count, all at one time."""
    store = Store.open(tmp_path_factory.mktemp("counted"))
    with StoreSink(store).open("drive", {}) as session:
        for number, count in enumerate(COUNTS):
            topic = session.topic(f"/{number}", COUNTER, {})
            topic.write(
                pa.RecordBatch.from_pylist([{"timestamp_ns": STAMP, "count": count}], schema=topic.schema)
            )
    return store


@pytest.mark.parametrize("bound", [-1, 0, 0.5, 2.0**53, 2**53 + 1, 2**63, 2**64 - 1, 2.0**64, 1e300], ids=str)
@pytest.mark.parametrize("name", [*SPANS, "$neq", "$in", "$outside"])
def test_query_large_integers_are_compared_exactly(counted: Store, name: str, bound: float) -> None:
    compare = {
        **SPANS,
        "$neq": operator.ne,
        "$in": lambda count, bounds: count in bounds,
        "$outside": lambda count, bounds: count < bounds[0] or count > bounds[1],
    }[name]
    asked = [bound, bound] if name in {"$in", "$outside"} else bound
    expected = {
        f"drive/{number}"
        for number, count in enumerate(COUNTS)
        if count is not None and compare(count, asked)
    }
    assert set(found(counted, ontology={"Counter.count": {name: asked}})) == expected


def test_query_timestamp_accepts_float_bounds(counted: Store) -> None:
    assert len(found(counted, ontology={"Counter.timestamp_ns": {"$between": [1.6e18, 1.8e18]}})) == 5
    assert found(counted, ontology={"Counter.timestamp_ns": {"$lt": 1.7e18}}) == {}


NAMES = ("", "a", "b", "ab", "a]b", "[a", "-", "\\", "a\nb", "aXbYa", "ż.", "ż#")
NAMED = pa.table({"name": NAMES})


@given(pattern=st.text("ab*?[]!-\\^.ż&|", max_size=8))
def test_glob_any_pattern_matches_values_and_columns_like_fnmatch(pattern: str) -> None:
    expected = [name for name in NAMES if fnmatchcase(name, pattern)]
    assert [name for name in NAMES if Glob(pattern).holds(name)] == expected
    column = Glob(pattern).column(pc.field("name"), pa.string())
    assert NAMED.filter(column)["name"].to_pylist() == expected


def test_query_segments_outside_bounds_are_not_opened(filled: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(*_: object, **__: object) -> None:
        pytest.fail("a segment was opened")

    monkeypatch.setattr("mosaico_ingest.serve.query.ds.dataset", opened)
    assert found(filled, ontology={"Pose.at.x": {"$gt": 5000}}) == {}
    assert found(filled, ontology={"Pose.timestamp_ns": {"$lt": 0}}) == {}


@pytest.mark.parametrize(
    "question",
    [
        {"sequence": {"color": {"$eq": 1}}},
        {"topic": {"name": {"$like": "x"}}},
        {"topic": {"name": "x"}},
        {"topic": {"name": {"$between": [1]}}},
        {"ontology": {"Pose": {"$eq": 1}}},
        {"ontology": {"Pose.at.x": {"$eq": "text"}}},
        {"ontology": {"Pose.at.x": {"$match": "text"}}},
        {"ontology": {"Pose.at": {"$gt": 1}}},
        {"ontology": {"Pose.path.item": {"$gt": 1}}},
        {"ontology": {"Pose.at.x": {"$in": ["text"]}}},
    ],
    ids=str,
)
def test_query_with_invalid_condition_is_refused(
    server: Server, client: Client, question: Mapping[str, Any]
) -> None:
    store = Store.open(server.store_path)
    with StoreSink(store).open("drive", {}) as session:
        session.topic("/pose", POSE, {}).write(poses(range(10), 0))
    with refused(Condition.INVALID):
        client.call("query", **question)


def test_query_action_returns_matching_locators(server: Server, client: Client) -> None:
    store = Store.open(server.store_path)
    with StoreSink(store).open("drive", {}) as session:
        session.topic("/pose", POSE, {}).write(poses(range(10), 0))
    assert client.call("query", ontology={"Pose.at.x": {"$gt": 3}}) == {
        "items": [{"sequence": "drive", "topics": [{"locator": "drive/pose", "ontology_tag": "Pose"}]}]
    }
