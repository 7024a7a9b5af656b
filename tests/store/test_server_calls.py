"""Every call a client makes, and the status of every one that is refused."""

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
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve import Server, serve

Rows = Callable[..., pa.RecordBatch]


def test_the_handshake_says_what_is_spoken_and_what_fits(client: Client) -> None:
    info = client.call("info")
    assert info["semver"] == {"major": 0, "minor": 7, "patch": 0, "pre": None}
    assert info["config"]["grpc_max_decode_message_size"] == 50_000_000
    assert client.call("version") == {"version": "0.7.0"}


def test_a_sequence_is_written_listed_described_and_read(client: Client, rows: Rows) -> None:
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


def test_a_time_range_has_its_start_inside_and_its_end_outside(client: Client, rows: Rows) -> None:
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


def test_large_rows_come_in_messages_of_a_moderate_size(server: Server, client: Client) -> None:
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


def test_notifications_are_kept_listed_and_purged(client: Client, rows: Rows) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    session = client.call("session_create", locator="drive")
    uuid = client.create_topic(session["uuid"], "drive/imu")
    note = {"notification_type": "error"}
    client.call("topic_notification_create", locator="drive/imu", msg="early", **note)
    client.put("drive/imu", uuid, rows([1]))
    client.call("session_finalize", session_uuid=session["uuid"])
    client.call("topic_notification_create", locator="drive/imu", msg="late", **note)
    client.call("sequence_notification_create", locator="drive", msg="all", **note)
    told = client.call("topic_notification_list", locator="drive/imu")["notifications"]
    assert [(each["name"], each["notification_type"], each["msg"]) for each in told] == [
        ("drive/imu", "error", "early"),
        ("drive/imu", "error", "late"),
    ]
    assert datetime.fromisoformat(told[0]["created_datetime"]).tzinfo is not None
    assert len(client.call("sequence_notification_list", locator="drive")["notifications"]) == 1
    client.call("topic_notification_purge", locator="drive/imu")
    client.call("sequence_notification_purge", locator="drive")
    assert client.call("topic_notification_list", locator="drive/imu")["notifications"] == []
    assert client.call("sequence_notification_list", locator="drive")["notifications"] == []


def test_sessions_topics_and_sequences_are_deleted(server: Server, client: Client, rows: Rows) -> None:
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


def test_a_topic_that_was_announced_only_can_be_taken_back(client: Client, rows: Rows) -> None:
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


def test_what_is_taken_missing_or_malformed_is_refused(client: Client, rows: Rows) -> None:
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


def test_a_refusal_does_not_carry_what_caused_it(client: Client) -> None:
    client.call("sequence_create", locator="somebody_elses", user_metadata={})
    for call in (
        lambda: client.info("nobodys"),
        lambda: client.call("sequence_delete", locator="nobodys"),
        lambda: client.call("sequence_create", locator="a b", user_metadata={}),
    ):
        with pytest.raises(pa.ArrowException) as told:
            call()
        assert "direct cause" not in str(told.value)
        assert "somebody_elses" not in str(told.value)


def test_a_topic_is_put_once_by_its_uuid_with_a_time_column(client: Client, rows: Rows) -> None:
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


def test_a_session_that_could_not_be_finalized_is_not_called_final(
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


def test_a_topic_is_taken_while_its_session_is_being_finalized(
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


def test_columns_are_put_in_order_and_the_time_column_may_be_nullable(client: Client) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/imu", pa.record_batch({"x": [1.5, 2.5], "timestamp_ns": [2, 1]}))
    schema = client.flight.get_schema(descriptor_of(resource_locator="drive/imu")).schema
    assert str(schema) == "timestamp_ns: int64 not null\nx: double"
    assert client.rows("drive/imu") == [1, 2]
    session = client.call("session_create", locator="drive")["uuid"]
    uuid = client.create_topic(session, "drive/bad")
    with refused(Condition.INVALID, "timestamp_ns"):
        client.put("drive/bad", uuid, pa.record_batch({"timestamp_ns": pa.array([None], pa.int64())}))
    with refused(Condition.PRECONDITION, "broke off"):
        client.call("session_finalize", session_uuid=session)


def test_a_signal_is_heard_that_another_thread_was_given(server: Server) -> None:
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


def test_many_clients_write_and_read_at_once(server: Server, rows: Rows) -> None:
    start = threading.Barrier(6)

    def work(number: int) -> list[int]:
        with Client(server) as client:
            start.wait(20)
            client.call("sequence_create", locator=f"s{number}", user_metadata={})
            client.upload(f"s{number}", "/t", *(rows([step * 10 + number]) for step in range(20)))
            return client.rows(f"s{number}/t")

    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(work, range(6)))
    assert found == [[step * 10 + number for step in range(20)] for number in range(6)]


def test_what_was_not_finalized_goes_with_the_server(tmp_path: Path, rows: Rows) -> None:
    with serve(tmp_path / "served", port=0) as running, Client(running) as client:
        client.call("sequence_create", locator="drive", user_metadata={})
        session = client.call("session_create", locator="drive")["uuid"]
        client.put("drive/imu", client.create_topic(session, "drive/imu"), rows([1]))
    store = Store.open(tmp_path / "served")
    assert store.sequence("drive").topics == ()
    assert list(store.path.rglob("*.parquet")) == []


def test_a_session_nobody_speaks_of_any_more_is_discarded(tmp_path: Path, rows: Rows) -> None:
    with serve(tmp_path / "store", port=0, idle_s=0.4) as server, Client(server) as client:
        client.call("sequence_create", locator="drive", user_metadata={})
        session = client.call("session_create", locator="drive")
        for number in range(4):  # longer than the limit, but never silent for so long
            uuid = client.create_topic(session["uuid"], f"drive/{number}")
            client.put(f"drive/{number}", uuid, rows([1]))
            time.sleep(0.15)
        time.sleep(1)
        assert client.info("drive")[0]["sessions"] == []
        with refused(Condition.NOT_FOUND, "no open session"):
            client.call("session_finalize", session_uuid=session["uuid"])
        assert list((tmp_path / "store").rglob("*.parquet")) == []


def test_a_port_that_is_taken_is_said_so(server: Server, tmp_path: Path) -> None:
    with pytest.raises(SinkError, match=f"{server.port}.*the port is free"):
        serve(tmp_path / "another", port=server.port)
