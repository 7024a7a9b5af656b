"""Listings of a store: pages and filters give the same sequences as reading the complete entries."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from object_store import ObjectStore

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import SequenceSummary, Store, StoreSink
from mosaico_ingest.destinations.store.model import SequenceFilter
from mosaico_ingest.ontology.registry import OntologyType

Rows = Callable[..., pa.RecordBatch]
METADATA: dict[str, dict[str, Any]] = {
    "yard_1": {"vehicle": {"id": "v1"}, "run": 1},
    "yard_2": {"vehicle": {"id": "v2"}, "run": 2, "night": True},
    "road_[a]": {"vehicle": "v1", "run": 1.5, "night": False, "mosaico_ingest": {"family": "road"}},
    "road-b": {"run": None, "tags": ["wet", "cold"], "mosaico_ingest": {"family": "road"}},
    "Yard_3": {},
}


@pytest.fixture(params=["folder", pytest.param("url", marks=pytest.mark.slow)])
def filled(request: pytest.FixtureRequest, tmp_path: Path, rows: Rows, sample: OntologyType) -> Store:
    """A store with complete, failed and empty sequences, on the disk and behind a URL."""
    location: str | Path = tmp_path / "listed"
    if request.param == "url":
        objects: ObjectStore = request.getfixturevalue("objects")
        location = objects.url(f"listed/{tmp_path.name}")
    store = Store.open(location)
    sink = StoreSink(store, 1 << 20)
    for number, (name, metadata) in enumerate(METADATA.items()):
        if name == "Yard_3":
            store.create_sequence(name, metadata)
            continue
        with sink.open(name, metadata) as session:
            for topic in range(number):
                session.topic(f"/t{topic}", sample, {}).write(rows(list(range(number + topic))))
            if name == "yard_2":
                session.note_error("stopped before the end")
            if name == "road-b":
                session.note_error("a topic failed", topic="/t0")
    return store


def test_listing_without_filter_equals_complete_entries(filled: Store) -> None:
    listing = filled.listing()
    assert listing.sequences == tuple(map(SequenceSummary.of, filled.sequences()))
    assert (listing.total, listing.next_after) == (len(METADATA), None)


@pytest.mark.parametrize(
    ("family", "names", "expected"),
    [
        ("road", {"/t0", "/t9"}, [("road_[a]", "/t0"), ("road-b", "/t0")]),
        ("road", {"/t2"}, [("road-b", "/t2")]),
        (None, {"/t0"}, [("yard_2", "/t0")]),
        ("yard", {"/t0"}, []),
    ],
)
def test_family_topics_selects_family_and_names_by_session(
    filled: Store, family: str | None, names: set[str], expected: list[tuple[str, str]]
) -> None:
    topics = filled.catalog.family_topics(family, names)
    assert [(topic.sequence, topic.name) for topic in topics] == expected
    assert all(topic.metadata == filled.topic(topic.sequence, topic.name).metadata for topic in topics)


@pytest.mark.parametrize("limit", [1, 2, 3, 5, 6])
def test_listing_pages_together_equal_complete_listing(filled: Store, limit: int) -> None:
    names, after = list[str](), None
    while True:
        page = filled.listing(after=after, limit=limit)
        assert len(page.sequences) <= limit
        assert page.total == len(METADATA)
        names += [summary.name for summary in page.sequences]
        after = page.next_after
        if after is None:
            break
    assert names == sorted(METADATA)


@pytest.mark.parametrize(
    ("match", "metadata", "incomplete", "expected"),
    [
        ("yard_*", {}, False, ["yard_1", "yard_2"]),
        ("[!r]*", {}, False, ["Yard_3", "yard_1", "yard_2"]),
        ("road_[[]a]", {}, False, ["road_[a]"]),
        (None, {"vehicle.id": "v1"}, False, ["yard_1"]),
        (None, {"vehicle": "v1"}, False, ["road_[a]"]),
        (None, {"run": "1.5"}, False, ["road_[a]"]),
        (None, {"night": "true"}, False, ["yard_2"]),
        (None, {"run": "null"}, False, ["road-b"]),
        (None, {"tags": '["wet","cold"]'}, False, ["road-b"]),
        (None, {"run": "1", "vehicle.id": "v1"}, False, ["yard_1"]),
        (None, {"missing": ""}, False, []),
        (None, {}, True, ["Yard_3", "yard_2"]),
        ("yard*", {}, True, ["yard_2"]),
    ],
)
def test_listing_with_filter_selects_sequences(
    filled: Store, match: str | None, metadata: dict[str, str], *, incomplete: bool, expected: list[str]
) -> None:
    listing = filled.listing(match=match, metadata=metadata, incomplete=incomplete)
    assert [summary.name for summary in listing.sequences] == expected
    assert listing.total == len(expected)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    match=st.none() | st.text("adry_[]!*?-1", max_size=6),
    metadata=st.dictionaries(
        st.sampled_from(["vehicle", "vehicle.id", "run", "night", "a.b"]),
        st.sampled_from(["v1", "1", "2", "true", "false", "null", ""]),
        max_size=2,
    ),
    incomplete=st.booleans(),
    limit=st.none() | st.integers(0, 4),
)
def test_listing_of_catalog_equals_filter_of_entries(
    store: Store,
    sink: StoreSink,
    *,
    match: str | None,
    metadata: dict[str, str],
    incomplete: bool,
    limit: int | None,
) -> None:
    if not store.names():
        for name, values in METADATA.items():
            with sink.open(name, values) as session:
                if name == "yard_1":
                    session.note_error("stopped before the end")
    selection = SequenceFilter(match, metadata, incomplete)
    expected = [info.name for info in store.sequences() if selection.selects(info)]
    listing = store.listing(match=match, metadata=metadata, incomplete=incomplete, limit=limit)
    assert [summary.name for summary in listing.sequences] == expected[:limit]
    assert listing.total == len(expected)


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int | str | None, str]:
    """Run `ingest store ls`; return its exit code and standard output."""
    with pytest.raises(SystemExit) as ended:
        main(["store", "ls", *arguments])
    return ended.value.code, capsys.readouterr().out


def test_store_ls_with_limit_names_the_next_page(
    store: Store, sink: StoreSink, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(3):
        with sink.open(f"drive_{number}", {"run": number}):
            pass
    folder = str(store.path)
    code, output = run(capsys, "--store", folder, "--limit", "2")
    assert code == 0
    assert "2 of 3 sequences" in output
    assert "--after drive_1" in output
    _, rest = run(capsys, "--store", folder, "--limit", "2", "--after", "drive_1", "--json")
    assert [each["name"] for each in json.loads(rest)] == ["drive_2"]


def test_store_ls_json_lists_all_sequences_by_default(
    store: Store, sink: StoreSink, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(102):
        with sink.open(f"drive_{number:03}", {"run": number}):
            pass
    folder = str(store.path)
    assert len(json.loads(run(capsys, "--store", folder, "--json")[1])) == 102
    assert "100 of 102 sequences" in run(capsys, "--store", folder)[1]
    assert json.loads(run(capsys, "drive_00[0-4]", "-m", "run=3", "--store", folder, "--json")[1])[0][
        "name"
    ] == ("drive_003")


def test_store_ls_with_malformed_metadata_condition_exits_two(
    store: Store, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "-m", "run", "--store", str(store.path))[0] == 2
