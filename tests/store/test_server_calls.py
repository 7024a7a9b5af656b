"""Calls of a client, and the status of each refused call."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from flight_calls import Client, descriptor_of, refused

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.destinations.store.catalog import Catalog
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve import Server, serve

Rows = Callable[..., pa.RecordBatch]


def test_info_returns_version_and_message_limit(client: Client) -> None:
    info = client.call("info")
    assert info["semver"] == {"major": 0, "minor": 7, "patch": 0, "pre": None}
    assert info["config"]["grpc_max_decode_message_size"] == 50_000_000
    assert client.call("version") == {"version": "0.7.0"}


def test_uploaded_sequence_is_listed_described_and_read(client: Client, rows: Rows) -> None:
    assert client.call("sequence_create", locator="drive", user_metadata={"car": [7]}) is None
    session = client.call("session_create", locator="drive")
    assert set(session) == {"uuid", "locator"}
    uuid = client.create_topic(session["uuid"], "drive/front/imu", mount="roof")
    client.put("drive/front/imu", uuid, rows([3, 1]), rows([2, 9]))
    empty = client.create_topic(session["uuid"], "drive/empty")
    client.put("drive/empty", empty, schema=rows([]).schema)
    opened, _ = client.info("drive")
    assert [(each["locator"], each["locked"]) for each in opened["sessions"]] == [(session["locator"], False)]
    assert client.call("session_finalize", session_uuid=session["uuid"]) is None

    assert [info.descriptor.path for info in client.flight.list_flights()] == [[b"drive"]]
    described, (nothing, imu) = client.info("drive")
    assert (described["resource_locator"], described["user_metadata"]) == ("drive", {"car": [7]})
    (finalized,) = described["sessions"]
    assert (finalized["locator"], finalized["locked"]) == (session["locator"], True)
    assert sorted(finalized["topics"]) == ["drive/empty", "drive/front/imu"]
    assert (imu["resource_locator"], imu["ontology_tag"]) == ("drive/front/imu", "Sample")
    assert (imu["serialization_format"], imu["user_metadata"]) == ("default", {"mount": "roof"})
    assert (imu["locked"], imu["time_window_info"]) == (True, None)
    assert imu["data_info"]["interval"] == {"start_ns": 1, "end_ns": 9}
    assert (imu["data_info"]["total_row_count"], nothing["data_info"]["total_row_count"]) == (4, 0)
    assert nothing["data_info"]["interval"] is None
    assert client.rows("drive/front/imu") == [1, 2, 3, 9]
    assert client.rows("drive/empty") == []
    schema = client.flight.get_schema(descriptor_of(resource_locator="drive/front/imu")).schema
    assert schema.equals(rows([]).schema)


def test_time_range_includes_start_and_excludes_end(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/imu", rows(range(100)))
    window = {"timestamp_ns_start": 10, "timestamp_ns_end": 13}
    _, (endpoint,) = client.info("drive/imu", **window)
    assert endpoint["time_window_info"] == {"interval": {"start_ns": 10, "end_ns": 12}, "row_count": 3}
    assert endpoint["data_info"]["total_row_count"] == 100
    assert client.rows("drive/imu", **window) == [10, 11, 12]
    assert client.rows("drive/imu", timestamp_ns_start=98) == [98, 99]
    _, (outside,) = client.info("drive/imu", timestamp_ns_start=1000)
    assert outside["time_window_info"] == {"interval": None, "row_count": 0}
    for window in (
        {"timestamp_ns_start": 5, "timestamp_ns_end": 5},
        {"timestamp_ns_start": 9, "timestamp_ns_end": 3},
    ):
        assert client.rows("drive/imu", **window) == []
        _, (nothing,) = client.info("drive/imu", **window)
        assert nothing["time_window_info"] == {"interval": None, "row_count": 0}


def test_do_get_large_rows_are_sent_in_small_batches(server: Server, client: Client) -> None:
    store = Store.open(server.store_path)
    raw = OntologyType("Raw", pa.struct([pa.field("data", pa.binary())]))
    with StoreSink(store).open("s", {}) as session:
        topic = session.topic("/raw", raw, {})
        blob = bytes(1 << 20)
        topic.write(
            pa.RecordBatch.from_arrays([pa.array(range(40)), pa.array([blob] * 40)], schema=topic.schema)
        )
    info = client.flight.get_flight_info(descriptor_of(resource_locator="s/raw"))
    sizes = [chunk.data.num_rows for chunk in client.flight.do_get(info.endpoints[0].ticket)]
    assert sum(sizes) == 40
    assert max(sizes) <= 16


def test_notifications_are_stored_listed_and_purged(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")
    uuid = client.create_topic(session["uuid"], "drive/imu")
    note = {"notification_type": "error"}
    client.call("topic_notification_create", locator="drive/imu", msg="early", **note)
    client.put("drive/imu", uuid, rows([1]))
    client.call("session_finalize", session_uuid=session["uuid"])
    client.call("topic_notification_create", locator="drive/imu", msg="late", **note)
    client.call("sequence_notification_create", locator="drive", msg="all", **note)
    response = client.call("topic_notification_list", locator="drive/imu")["notifications"]
    assert [(each["name"], each["notification_type"], each["msg"]) for each in response] == [
        ("drive/imu", "error", "early"),
        ("drive/imu", "error", "late"),
    ]
    assert datetime.fromisoformat(response[0]["created_datetime"]).tzinfo is not None
    assert len(client.call("sequence_notification_list", locator="drive")["notifications"]) == 1
    client.call("topic_notification_purge", locator="drive/imu")
    client.call("sequence_notification_purge", locator="drive")
    assert client.call("topic_notification_list", locator="drive/imu")["notifications"] == []
    assert client.call("sequence_notification_list", locator="drive")["notifications"] == []


def test_delete_removes_sessions_topics_sequences_and_files(
    server: Server, client: Client, rows: Rows
) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/a", rows([1]))
    client.upload("drive", "/b", rows([1]))
    opened = client.call("session_create", locator="drive")
    uuid = client.create_topic(opened["uuid"], "drive/c")
    client.put("drive/c", uuid, rows([1]))
    client.call("session_delete", locator=opened["locator"])
    described, _ = client.info("drive")
    _, second = described["sessions"]
    client.call("session_delete", locator=second["locator"])
    _, endpoints = client.info("drive")
    assert [each["resource_locator"] for each in endpoints] == ["drive/a"]
    client.call("topic_delete", locator="drive/a")
    assert client.info("drive")[1] == []
    client.call("sequence_delete", locator="drive")
    assert list(client.flight.list_flights()) == []
    assert list(Path(server.store_path).rglob("*.parquet")) == []


def test_topic_delete_before_upload_allows_new_upload(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")["uuid"]
    client.create_topic(session, "drive/a")
    with refused(Condition.PRECONDITION, "never uploaded"):
        client.call("session_finalize", session_uuid=session)
    client.call("topic_delete", locator="drive/a")
    with refused(Condition.PRECONDITION, "empty"):
        client.call("session_finalize", session_uuid=session)
    client.put("drive/a", client.create_topic(session, "drive/a"), rows([1]))
    with refused(Condition.PRECONDITION, "is uploaded"):
        client.call("topic_delete", locator="drive/a")
    client.call("session_finalize", session_uuid=session)


def test_request_with_existing_missing_or_invalid_name_is_refused(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.call("sequence_create", locator="other", user_metadata={})
    client.upload("drive", "/imu", rows([1]))
    session = client.call("session_create", locator="drive")["uuid"]
    with refused(Condition.EXISTS, "drive"):
        client.call("sequence_create", locator="drive", user_metadata={})
    with refused(Condition.EXISTS, "drive/imu"):
        client.create_topic(session, "drive/imu")
    with refused(Condition.PERMISSION, "other"):
        client.create_topic(session, "other/imu")
    for name, question in (
        ("session_create", {"locator": "nowhere"}),
        ("session_finalize", {"session_uuid": "nothing"}),
        ("sequence_delete", {"locator": "nowhere"}),
        ("session_delete", {"locator": "drive:01ABC"}),
        ("topic_delete", {"locator": "drive/nothing"}),
        ("topic_notification_list", {"locator": "drive/nothing"}),
        ("sequence_notification_create", {"locator": "nowhere", "notification_type": "error", "msg": "x"}),
    ):
        with refused(Condition.NOT_FOUND):
            client.call(name, **question)
    for name, question in (
        ("sequence_create", {"locator": "a b", "user_metadata": {}}),
        ("sequence_create", {"locator": "a", "user_metadata": {"x.y": 1}}),
        ("sequence_create", {"locator": "a"}),
        ("sequence_create", {"locator": "a", "user_metadata": None}),
        ("sequence_delete", {"locator": "drive/imu"}),
        ("topic_delete", {"locator": "drive"}),
        ("session_create", {}),
    ):
        with refused(Condition.INVALID):
            client.call(name, **question)
    with refused(Condition.INVALID):
        client.create_topic(session, "drive/a.b")
    for locator in ("drive/nothing", "nowhere"):
        with refused(Condition.NOT_FOUND):
            client.info(locator)
    for locator in ("drive:01ABC", "", "/drive"):
        with refused(Condition.INVALID):
            client.info(locator)
    with refused(Condition.INVALID):
        client.flight.get_schema(descriptor_of(resource_locator="drive"))
    with refused(Condition.INVALID):
        client.flight.get_flight_info(fl.FlightDescriptor.for_path("drive"))
    with refused(Condition.INVALID):
        list(client.flight.do_action(fl.Action("info", b"{")))
    with refused(Condition.INVALID):
        client.flight.do_get(fl.Ticket(b"\xff\x00")).read_all()
    with refused(Condition.UNIMPLEMENTED, "topic_filter_x"):
        client.call("topic_filter_x")


def test_refusal_contains_no_cause_and_no_other_names(client: Client) -> None:
    client.call("sequence_create", locator="somebody_elses", user_metadata={})
    for call in (
        lambda: client.info("nobodys"),
        lambda: client.call("sequence_delete", locator="nobodys"),
        lambda: client.call("sequence_create", locator="a b", user_metadata={}),
    ):
        with pytest.raises(pa.ArrowException) as caught:
            call()
        assert "direct cause" not in str(caught.value)
        assert "somebody_elses" not in str(caught.value)


def test_do_put_requires_uuid_and_time_column_and_is_accepted_once(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")["uuid"]
    uuid = client.create_topic(session, "drive/imu")
    with refused(Condition.PERMISSION):
        client.put("drive/gps", uuid, rows([1]))
    with refused(Condition.NOT_FOUND):
        client.put("drive/imu", "no-such-uuid", rows([1]))
    with refused(Condition.INVALID, "timestamp_ns"):
        client.put("drive/imu", uuid, pa.record_batch({"x": [1]}))
    client.put("drive/imu", uuid, rows([1]))
    with refused(Condition.PRECONDITION, "is uploaded"):
        client.put("drive/imu", uuid, rows([1]))
    client.call("session_finalize", session_uuid=session)
    with refused(Condition.PRECONDITION, "finalized"):
        client.call("session_finalize", session_uuid=session)
    with refused(Condition.PRECONDITION, "finalized"):
        client.create_topic(session, "drive/gps")


def test_session_with_failed_commit_is_not_finalized(
    client: Client, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(*_: object) -> list[str]:
        raise SinkUnavailable("the catalog is busy with another process")

    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")["uuid"]
    client.put("drive/imu", client.create_topic(session, "drive/imu"), rows([1]))
    with monkeypatch.context() as patched:
        patched.setattr(Catalog, "commit", busy)
        with refused(Condition.UNAVAILABLE, "busy"):
            client.call("session_finalize", session_uuid=session)
    with refused(Condition.NOT_FOUND, "no open session"):
        client.call("session_finalize", session_uuid=session)


def test_topic_of_session_being_finalized_already_exists(
    client: Client, rows: Rows, monkeypatch: pytest.MonkeyPatch
) -> None:
    def announced_again(*arguments: Any) -> Any:
        with refused(Condition.EXISTS):
            client.create_topic(other, "drive/imu")
        with refused(Condition.PRECONDITION, "finalized"):
            client.call("session_finalize", session_uuid=session)
        sessions = client.info("drive")[0]["sessions"]
        assert [each["locked"] for each in sessions] == [False, False]
        return commit(*arguments)

    commit = Catalog.commit
    client.call("sequence_create", locator="drive", user_metadata={})
    session, other = (client.call("session_create", locator="drive")["uuid"] for _ in range(2))
    client.put("drive/imu", client.create_topic(session, "drive/imu"), rows([1]))
    monkeypatch.setattr(Catalog, "commit", announced_again)
    client.call("session_finalize", session_uuid=session)
    assert client.rows("drive/imu") == [1]


def test_do_put_reorders_columns_and_accepts_nullable_time_column(client: Client) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/imu", pa.record_batch({"x": [1.5, 2.5], "timestamp_ns": [2, 1]}))
    schema = client.flight.get_schema(descriptor_of(resource_locator="drive/imu")).schema
    assert str(schema) == "timestamp_ns: int64 not null\nx: double"
    assert client.rows("drive/imu") == [1, 2]
    session = client.call("session_create", locator="drive")["uuid"]
    uuid = client.create_topic(session, "drive/bad")
    with refused(Condition.INVALID, "timestamp_ns"):
        client.put("drive/bad", uuid, pa.record_batch({"timestamp_ns": pa.array([None], pa.int64())}))
    with refused(Condition.PRECONDITION, "has an interrupted upload"):
        client.call("session_finalize", session_uuid=session)


def test_wait_signal_sent_to_other_thread_is_handled(server: Server) -> None:
    def heard(*_: object) -> None:
        raise InterruptedError

    def signal_in_a_thread() -> None:
        signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)

    at_last = threading.Timer(30, server.shutdown)
    before = signal.signal(signal.SIGUSR1, heard)
    try:
        at_last.start()
        threading.Timer(0.2, signal_in_a_thread).start()
        began = time.monotonic()
        with pytest.raises(InterruptedError):
            server.wait()
        assert time.monotonic() - began < 15
    finally:
        at_last.cancel()
        signal.signal(signal.SIGUSR1, before)


def test_concurrent_clients_write_and_read_their_own_rows(server: Server, rows: Rows) -> None:
    start = threading.Barrier(6)

    def work(number: int) -> list[int]:
        with Client(server) as client:
            start.wait(20)
            client.call("sequence_create", locator=f"s{number}", user_metadata={})
            client.upload(f"s{number}", "/t", *(rows([step * 10 + number]) for step in range(20)))
            return client.rows(f"s{number}/t")

    with ThreadPoolExecutor(6) as pool:
        actual = list(pool.map(work, range(6)))
    assert actual == [[step * 10 + number for step in range(20)] for number in range(6)]


def test_server_shutdown_discards_open_sessions(tmp_path: Path, rows: Rows) -> None:
    with serve(tmp_path / "served", port=0) as running, Client(running) as client:
        client.call("sequence_create", locator="drive", user_metadata={})
        session = client.call("session_create", locator="drive")["uuid"]
        client.put("drive/imu", client.create_topic(session, "drive/imu"), rows([1]))
    store = Store.open(tmp_path / "served")
    assert store.sequence("drive").topics == ()
    assert list(store.path.rglob("*.parquet")) == []


def test_session_idle_beyond_limit_is_discarded(tmp_path: Path, rows: Rows) -> None:
    with serve(tmp_path / "store", port=0, idle_s=0.4) as server, Client(server) as client:
        client.call("sequence_create", locator="drive", user_metadata={})
        session = client.call("session_create", locator="drive")
        for number in range(4):  # longer than the limit in total, but never idle for the limit
            uuid = client.create_topic(session["uuid"], f"drive/{number}")
            client.put(f"drive/{number}", uuid, rows([1]))
            time.sleep(0.15)
        time.sleep(1)
        assert client.info("drive")[0]["sessions"] == []
        with refused(Condition.NOT_FOUND, "no open session"):
            client.call("session_finalize", session_uuid=session["uuid"])
        assert list((tmp_path / "store").rglob("*.parquet")) == []


def test_serve_on_used_port_raises_with_port(server: Server, tmp_path: Path) -> None:
    with pytest.raises(SinkError, match=f"{server.port}.*the port is free"):
        serve(tmp_path / "another", port=server.port)
