"""Clients that send hostile or very many requests, and clients of several versions."""

from __future__ import annotations

import gc
import json
import os
import time
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.flight as fl
import pytest
from flight_calls import Client, descriptor_of, refused
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.values import select
from mosaico_ingest.protocol.errors import Condition, as_flight_error, condition_of
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.serve import Keyring, Server, query, serve
from mosaico_ingest.serve.actions import clusterize, intersect
from mosaico_ingest.serve.flights import Uploads
from mosaico_ingest.serve.guard import MAX_REFUSED_SCHEMAS, Deadline, Refusal
from mosaico_ingest.serve.query import Glob, run

Rows = Callable[..., pa.RecordBatch]
STARS = "a*" * 40 + "b"


def stream(client: Client, name: str, **body: Any) -> list[dict[str, Any]]:
    """Return the bodies of a streamed action, one per result."""
    action = fl.Action(name, json.dumps(body).encode())
    results = [result.body.to_pybytes() for result in client.flight.do_action(action, client.options)]
    assert all(result.endswith(b"\n") and json.loads(result)["action"] == name for result in results)
    return [json.loads(result)["response"] for result in results]


def spans(clusters: list[dict[str, Any]]) -> list[tuple[int, int]]:
    return [(each["ts"]["start_ns"], each["ts"]["end_ns"]) for each in clusters]


def test_match_with_many_stars_returns_quickly(client: Client) -> None:
    client.call("sequence_create", locator="a" * 200, user_metadata={})
    started = time.monotonic()
    for field in ("name", "locator"):
        assert client.call("query", sequence={field: {"$match": STARS}}) == {"items": []}
    assert time.monotonic() - started < 2


def test_topic_glob_with_many_stars_returns_quickly() -> None:
    started = time.monotonic()
    assert select([STARS], ["a" * 200]).selected == ()
    assert time.monotonic() - started < 2


@settings(deadline=None, max_examples=200)
@example(pattern="1[#", value="11")
@example(pattern="[]1[", value="1")
@example(pattern="[!]", value="[!]")
@given(pattern=st.text("ab*?[]!-#1", max_size=8), value=st.text("ab1]-#", max_size=6))
def test_match_of_values_equals_match_of_columns(pattern: str, value: str) -> None:
    glob = Glob(pattern)
    table = pa.table({"x": [value]})
    expression = glob.column(pa.compute.field("x"), pa.string())
    assert glob.holds(value) == (table.filter(expression).num_rows == 1)


def test_query_past_its_time_limit_is_refused(client: Client, server: Server) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    with pytest.raises(Refusal) as raised:
        run(Store.open(server.store_path), _query(), Deadline(-1))
    assert raised.value.condition is Condition.TIMED_OUT


def test_served_query_past_its_time_limit_is_refused(tmp_path: Path) -> None:
    with serve(tmp_path / "served", port=0, request_s=-1) as running, Client(running) as limited:
        limited.call("sequence_create", locator="drive", user_metadata={})
        with refused(Condition.TIMED_OUT):
            limited.call("query")


def _query() -> Any:
    from mosaico_ingest.protocol.messages import Query  # noqa: PLC0415 - one test needs it

    return Query()


def list_actions(client: Client) -> None:
    client.flight.list_actions(client.options)


def exchange(client: Client) -> None:
    _, reader = client.flight.do_exchange(fl.FlightDescriptor.for_command(b"{}"), client.options)
    reader.read_all()


def describe_missing(client: Client) -> None:
    client.info("nowhere")


def schema_of_missing(client: Client) -> None:
    client.flight.get_schema(fl.FlightDescriptor.for_command(b'{"resource_locator": "nowhere/x"}'))


def refusal(client: Client, call: Callable[[Client], None], count: int) -> str:
    """Repeat a call that is refused, and return the last message."""
    text = ""
    for _ in range(count):
        try:
            call(client)
        except (pa.ArrowException, OSError) as error:  # noqa: PERF203 - every request is refused
            text = str(error)
    return text


@pytest.mark.parametrize("call", [describe_missing, schema_of_missing, list_actions, exchange])
def test_refused_requests_leak_no_memory_and_no_paths(
    call: Callable[[Client], None], client: Client, capfd: pytest.CaptureFixture[str]
) -> None:
    def resident_bytes() -> int:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    text = refusal(client, call, MAX_REFUSED_SCHEMAS + 100)
    growth: list[float] = []  # a leak grows in every round, and the allocator in some
    while len(growth) < 3 and min(growth, default=300) >= 300:
        before = resident_bytes()
        text += refusal(client, call, 2000)
        growth.append((resident_bytes() - before) / 2000)
    assert min(growth) < 300
    assert "Traceback" not in text
    assert "/" not in text.partition("gRPC")[0]
    capfd.readouterr()  # Arrow prints a warning for each exchange


def test_refused_schema_names_no_path_and_is_limited_per_key(tmp_path: Path) -> None:
    keyring = Keyring(tmp_path / "keys.json")
    keys = [keyring.add(Permission.READ) for _ in range(2)]
    with serve(tmp_path / "served", port=0, keys=keyring) as running:
        texts: list[str] = []
        for key, count in zip(keys, (MAX_REFUSED_SCHEMAS + 1, 1), strict=True):
            with Client(running, key) as client:

                def call(client: Client = client) -> None:
                    command = fl.FlightDescriptor.for_command(b'{"resource_locator": "nowhere/x"}')
                    client.flight.get_schema(command, client.options)

                texts.append(refusal(client, lambda _: call(), count))
    assert "GetSchema" in texts[0]
    assert texts[1].startswith("Unknown error: NOT_FOUND")
    assert str(Path(__file__).parents[2]) not in texts[1]


@pytest.mark.parametrize("condition", list(Condition))
def test_every_status_is_sent_as_exception_of_flight(condition: Condition) -> None:
    error = as_flight_error(condition, "what")
    assert isinstance(error, fl.FlightError)
    assert condition_of(error) is condition


def test_sequence_name_above_255_characters_is_refused(client: Client) -> None:
    client.call("sequence_create", locator="a" * 255, user_metadata={})
    with refused(Condition.INVALID):
        client.call("sequence_create", locator="a" * 256, user_metadata={})


def test_abandoned_sessions_make_way_for_new_ones(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    store.create_sequence("drive", {})
    uploads = Uploads(store)
    monkeypatch.setattr("mosaico_ingest.serve.flights._MAX_SESSIONS", 3)
    opened = [uploads.open("drive") for _ in range(3)]
    with pytest.raises(Refusal) as raised:
        uploads.open("drive")
    assert raised.value.condition is Condition.UNAVAILABLE
    opened[1].last_call_s -= 1000
    uploads.open("drive")
    remaining = {each.uuid for each in uploads.of_sequence("drive")}
    assert opened[1].uuid not in remaining
    assert len(remaining) == 3
    uploads.close()


def test_open_sessions_keep_only_their_lock_open(store: Store) -> None:
    store.create_sequence("drive", {})
    uploads = Uploads(store)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(20):
        uploads.open("drive")
    assert len(list(Path("/proc/self/fd").iterdir())) - before <= 40
    uploads.close()


def test_query_by_locator_matches_as_sql_like(client: Client, rows: Rows) -> None:
    for name in ("drive_1", "drive_2"):
        client.call("sequence_create", locator=name, user_metadata={})
        client.upload(name, "/front/imu", rows([1]))

    def names(**question: Any) -> list[str]:
        return [item["sequence"] for item in client.call("query", **question)["items"]]

    assert names(sequence={"locator": {"$eq": "drive_1"}}) == ["drive_1"]
    assert names(sequence={"locator": {"$match": "riv"}}) == ["drive_1", "drive_2"]
    assert names(sequence={"locator": {"$match": "DRIVE"}}) == []
    assert names(sequence={"locator": {"$match": "dr%_2"}}) == ["drive_2"]
    assert names(sequence={"locator": {"$match": "*"}}) == []
    assert names(topic={"locator": {"$eq": "drive_2/front/imu"}}) == ["drive_2"]
    assert names(topic={"locator": {"$match": "1/front"}}) == ["drive_1"]


def test_topics_of_open_sessions_are_listed(client: Client) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")
    client.create_topic(session["uuid"], "drive/imu")
    described, endpoints = client.info("drive")
    assert [each["topics"] for each in described["sessions"]] == [["drive/imu"]]
    assert [(each["resource_locator"], each["locked"]) for each in endpoints] == [("drive/imu", False)]


ANY: dict[str, Any] = {"Sample.timestamp_ns": {"$geq": 0}}


def test_clusterize_groups_matching_rows_by_gaps(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/imu", rows([1, 2, 3, 10, 11, 30]))
    question = {"locator": "drive/imu", "ontology": ANY}
    assert spans(stream(client, "topic_filter_clusterize", **question)) == [(1, 30)]
    assert spans(stream(client, "topic_filter_clusterize", **question, clustering_dt_ns=7)) == [
        (1, 11),
        (30, 30),
    ]
    grouped = stream(client, "topic_filter_clusterize", **question, clustering_dt_ns=6)
    assert spans(grouped) == [(1, 3), (10, 11), (30, 30)]
    assert [each["id"] for each in grouped] == [0, 1, 2]
    bounds = {"start_ns": 2, "end_ns": 11}
    within = stream(client, "topic_filter_clusterize", **question, clustering_dt_ns=6, timestamp_range=bounds)
    assert spans(within) == [(2, 3), (10, 10)]
    matching = {"locator": "drive/imu", "ontology": {"Sample.timestamp_ns": {"$gt": 100}}}
    assert stream(client, "topic_filter_clusterize", **matching) == []


@pytest.mark.parametrize("ontology", [{"Other.x": {"$gt": 1}}, {}])
def test_clusterize_without_condition_on_its_topic_is_refused(
    ontology: dict[str, Any], client: Client, rows: Rows
) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/imu", rows([1]))
    with refused(Condition.INVALID):
        stream(client, "topic_filter_clusterize", locator="drive/imu", ontology=ontology)


def test_intersect_returns_common_times_of_topics(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/a", rows([1, 2, 3, 20, 21]))
    client.upload("drive", "/b", rows([2, 4, 24]))
    topics = [{"locator": f"drive/{name}", "clustering_dt_ns": 5, "ontology": ANY} for name in "ab"]
    assert spans(stream(client, "topic_filter_intersect", topics=topics)) == [(2, 3)]
    assert spans(stream(client, "topic_filter_intersect", topics=topics, intersect_dt_ns=3)) == [
        (2, 3),
        (23, 23),
    ]


@pytest.mark.parametrize("locators", [["drive/a"], ["drive/a", "other/a"]])
def test_intersect_of_one_topic_or_of_two_sequences_is_refused(
    locators: list[str], client: Client, rows: Rows
) -> None:
    for sequence in ("drive", "other"):
        client.call("sequence_create", locator=sequence, user_metadata={})
        client.upload(sequence, "/a", rows([1]))
    topics = [{"locator": locator, "ontology": ANY} for locator in locators]
    with refused(Condition.INVALID):
        stream(client, "topic_filter_intersect", topics=topics)


def test_clusterize_and_intersect_of_nothing_are_empty() -> None:
    assert clusterize(np.array([], np.int64), 5) == []
    assert list(intersect([[(1, 2)], []], 10)) == []


@pytest.mark.parametrize(
    ("clusters", "tolerance_ns", "ranges"),
    [
        ([[(100, 110), (500, 510)], [(105, 115), (495, 505)]], 0, [(105, 110), (500, 505)]),
        ([[(100, 200)], [(120, 180)], [(130, 170)]], 0, [(130, 170)]),
        ([[(100, 140)], [(155, 200)]], 20, [(145, 150)]),
        ([[(100, 140)], [(155, 200)]], 15, [(148, 148)]),
        ([[(100, 140)], [(155, 200)]], 14, []),
    ],
)
def test_intersect_of_clusters_returns_ranges_of_the_platform(
    clusters: list[list[tuple[int, int]]], tolerance_ns: int, ranges: list[tuple[int, int]]
) -> None:
    assert list(intersect(clusters, tolerance_ns)) == ranges


def test_key_added_while_serving_is_accepted_and_revoked_key_refused(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    key = Keyring(path).add(Permission.READ)
    with serve(tmp_path / "served", port=0, keys=Keyring(path)) as running:
        other = Keyring(path).add(Permission.MANAGE, description="later")
        with Client(running, other) as later:
            listed = later.call("api_key_list")["api_keys"]
            assert [each["description"] for each in listed] == ["", "later"]
            later.call("api_key_revoke", api_key_fingerprint=key[-8:])
            with refused(Condition.NOT_FOUND):
                later.call("api_key_revoke", api_key_fingerprint=key[-8:])
        with Client(running, key) as revoked, refused(Condition.UNAUTHENTICATED):
            revoked.call("info")


def test_api_key_actions_create_and_describe_keys(tmp_path: Path) -> None:
    keyring = Keyring(tmp_path / "keys.json")
    manage, write = keyring.add(Permission.MANAGE), keyring.add(Permission.DELETE)
    expires = datetime(2200, 1, 1, tzinfo=timezone.utc)
    with serve(tmp_path / "served", port=0, keys=keyring) as running, Client(running, manage) as client:
        token = client.call(
            "api_key_create",
            permissions="write",
            description="robot",
            expires_at_ns=int(expires.timestamp()) * 10**9,
        )["api_key_token"]
        status = client.call("api_key_status", api_key_fingerprint=token[-8:])
        assert (status["description"], status["expires_at_ns"]) == ("robot", int(expires.timestamp()) * 10**9)
        assert keyring.permission_of(token) is Permission.WRITE
        with Client(running, write) as other, refused(Condition.PERMISSION):
            other.call("api_key_list")


def test_api_key_actions_without_keys_are_refused(client: Client) -> None:
    with refused(Condition.PRECONDITION):
        client.call("api_key_list")


def test_query_by_locator_supports_other_operators() -> None:
    assert query.tests_of({"$eq": "a"}, of="locator")[0].holds("a")


def test_get_schema_of_missing_topic_is_not_found(client: Client) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    with refused(Condition.NOT_FOUND):
        client.flight.get_schema(descriptor_of(resource_locator="drive/nothing"))
