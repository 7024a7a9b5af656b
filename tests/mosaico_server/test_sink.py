from __future__ import annotations

import logging
import os
import pickle
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from mosaicod import Mosaicod, Proxy, exists, make_key, precondition, running

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.server.client import Address, connect
from mosaico_ingest.destinations.server.destination import ServerDestination, ServerSink
from mosaico_ingest.destinations.server.session import ServerSession
from mosaico_ingest.errors import Interrupted, SequenceExists, SinkError, SinkUnavailable
from mosaico_ingest.job.values import IfExists, ServerTarget, SessionLevelErrorPolicy
from mosaico_ingest.ontology import Integer64
from mosaico_ingest.ontology.registry import OntologyType

NUMBER = Integer64.ontology_type()
BLOB = OntologyType("Blob", pa.struct([pa.field("data", pa.binary(), nullable=False)]))
META = {"car": 7}


def numbers(*times: int) -> pa.RecordBatch:
    return pa.record_batch([pa.array(times, pa.int64())] * 2, topic_schema(NUMBER))


def blobs(*sizes: int) -> pa.RecordBatch:
    times = pa.array(range(len(sizes)), pa.int64())
    return pa.record_batch(
        [times, pa.array([b"x" * size for size in sizes], pa.binary())], topic_schema(BLOB)
    )


@pytest.fixture
def server() -> Iterator[Mosaicod]:
    with running(Mosaicod()) as server:
        yield server


def target(server: Any, **options: Any) -> ServerTarget:
    return ServerTarget("127.0.0.1", server.port, **options)


def write(server: Mosaicod, *times: int, if_exists: IfExists = IfExists.FAIL, topic: str = "/n") -> None:
    with ServerSink(target(server)).open("seq", META, if_exists=if_exists) as session:
        session.topic(topic, NUMBER, {"unit": "m"}).write(numbers(*times))


def test_sink_upload_sends_protocol_calls_in_order(server: Mosaicod) -> None:
    write(server, 1, 2)
    assert server.calls == [
        "info",
        "get_flight_info",
        "sequence_create",
        "session_create",
        "topic_create",
        "do_put",
        "session_finalize",
    ]
    session_uuid = next(iter(server.sessions))
    assert server.bodies[1:4] == [
        ("sequence_create", {"locator": "seq", "user_metadata": META}),
        ("session_create", {"locator": "seq"}),
        (
            "topic_create",
            {
                "session_uuid": session_uuid,
                "locator": "seq/n",
                "serialization_format": "default",
                "ontology_tag": "Integer64",
                "user_metadata": {"unit": "m"},
            },
        ),
    ]
    assert server.topics["seq/n"].schema == topic_schema(NUMBER)
    assert server.topics["seq/n"].table().to_batches() == [numbers(1, 2)]


def test_stored_returns_rows_and_time_range_of_server(server: Mosaicod) -> None:
    with ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/n", NUMBER, {}).write(numbers(3, 1, 2))
        session.topic("/empty", NUMBER, {})
    contents, empty = session.stored()
    assert (contents.topic, contents.rows, contents.start_ns, contents.end_ns) == ("/n", 3, 1, 3)
    assert (empty.rows, empty.start_ns, empty.stored_bytes) == (0, None, 0)
    assert server.topics["seq/empty"].state == "final"


def test_upload_coalesces_small_batches_and_splits_large_ones() -> None:
    with running(Mosaicod(message_bytes=100_000)) as server:
        with ServerSink(target(server)).open("seq", {}) as session:
            few = session.topic("/few", NUMBER, {})
            many = session.topic("/many", BLOB, {})
            for at in range(100):
                few.write(numbers(at))
            many.write(blobs(*[30_000] * 7))
        assert [chunk.num_rows for chunk in server.topics["seq/few"].chunks] == [100]
        assert [chunk.num_rows for chunk in server.topics["seq/many"].chunks] == [2, 2, 2, 1]


def test_write_row_above_message_limit_raises_and_topic_continues() -> None:
    with running(Mosaicod(message_bytes=100_000)) as server:
        with ServerSink(target(server)).open("seq", {}) as session:
            writer = session.topic("/b", BLOB, {})
            with pytest.raises(
                SinkError,
                match=r"/b: the row of 1 ns has 9.* bytes; the server accepts messages of 100000 bytes",
            ):
                writer.write(blobs(5, 95_000))
            writer.write(blobs(6))
        assert server.topics["seq/b"].table().column("data").to_pylist() == [b"x" * 6]


def test_session_buffered_bytes_of_all_topics_stay_within_limit(server: Mosaicod) -> None:
    with ServerSink(target(server), buffer_bytes=10_000).open("seq", {}) as session:
        writers = [session.topic(f"/t{n}", BLOB, {}) for n in range(4)]
        for _ in range(10):
            for writer in writers:
                writer.write(blobs(1000))
                assert sum(w.buffered_bytes for w in writers) <= 10_000  # type: ignore[attr-defined]  # the class is known
    assert all(len(topic.chunks) > 1 for topic in server.topics.values())


def test_session_topics_written_in_threads_store_every_row(server: Mosaicod) -> None:
    with ServerSink(target(server), buffer_bytes=20_000).open("seq", {}) as session:
        writers = [session.topic(f"/t{n}", NUMBER, {}) for n in range(6)]
        threads = [
            threading.Thread(target=lambda w=w: [w.write(numbers(at)) for at in range(300)]) for w in writers
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert [topic.rows for topic in session.stored()] == [300] * 6


def test_session_exception_deletes_new_sequence(server: Mosaicod) -> None:
    with pytest.raises(ZeroDivisionError), ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/n", NUMBER, {}).write(numbers(1))
        raise ZeroDivisionError
    assert (server.sequences, server.sessions, server.topics) == ({}, {}, {})
    write(server, 1)


def test_append_session_exception_keeps_sequence(server: Mosaicod) -> None:
    write(server, 1)
    sink = ServerSink(target(server))
    with pytest.raises(ZeroDivisionError), sink.open("seq", {}, if_exists=IfExists.APPEND) as session:
        session.topic("/m", NUMBER, {}).write(numbers(1))
        raise ZeroDivisionError
    assert list(server.topics) == ["seq/n"]


def test_session_without_topics_creates_sequence_only(server: Mosaicod) -> None:
    with ServerSink(target(server)).open("seq", META) as session:
        pass
    assert server.sequences == {"seq": META}
    assert "session_create" not in server.calls
    assert session.stored() == ()


def test_append_adds_new_topics_and_refuses_existing_ones(server: Mosaicod) -> None:
    write(server, 1)
    write(server, 2, if_exists=IfExists.APPEND, topic="/m")
    assert set(server.topics) == {"seq/n", "seq/m"}
    with pytest.raises(SinkError, match="/n: the topic already exists in the sequence"):
        write(server, 3, if_exists=IfExists.APPEND)
    assert server.topics["seq/n"].table().num_rows == 1


def test_replace_deletes_old_sequence(server: Mosaicod) -> None:
    write(server, 1)
    write(server, 2, 3, if_exists=IfExists.REPLACE, topic="/m")
    assert set(server.topics) == {"seq/m"}


def test_replace_with_refused_create_reports_deleted_sequence(server: Mosaicod) -> None:
    write(server, 1)
    server.faults.refuse["sequence_create"] = [pa.ArrowInvalid("odd name")]
    with pytest.raises(SinkError, match="sequence_create is refused: odd name") as raised:
        write(server, 2, if_exists=IfExists.REPLACE)
    assert str(raised.value.hint).endswith("run the same command again to upload it")
    assert server.sequences == {}
    write(server, 2, if_exists=IfExists.REPLACE)
    assert server.topics["seq/n"].table()["timestamp_ns"].to_pylist() == [2]


def test_replace_interrupted_during_upload_reports_deleted_sequence(
    server: Mosaicod, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: ServerSession) -> None:
        raise KeyboardInterrupt

    write(server, 1)
    monkeypatch.setattr(ServerSession, "_delete_broken_topics", interrupt)
    with pytest.raises(Interrupted) as raised:
        write(server, 2, if_exists=IfExists.REPLACE)
    assert str(raised.value.hint).endswith("run the same command again to upload it")


def test_open_sequence_created_concurrently_raises_sequence_exists(server: Mosaicod) -> None:
    server.faults.refuse["sequence_create"] = [exists("sequence seq")]
    with pytest.raises(SequenceExists, match=r"^seq: "):
        write(server, 1)


def test_open_invalid_name_or_metadata_raises_before_connecting() -> None:
    nowhere = ServerSink(ServerTarget("127.0.0.1", 1))
    with pytest.raises(SinkError, match="sequence name"), nowhere.open("a b", {}):
        pytest.fail("opened")
    with pytest.raises(SinkError, match="metadata key"), nowhere.open("seq", {"a.b": 1}):
        pytest.fail("opened")


def test_note_error_is_stored_for_topic_or_sequence(server: Mosaicod) -> None:
    with ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/n", NUMBER, {})
        session.note_error("stopped")
        session.note_error("one row lost", topic="/n")
        session.note_error("never opened", topic="/x")
    assert server.notes == {"seq": ["stopped", "/x: never opened"], "seq/n": ["one row lost"]}


def test_stored_on_older_server_counts_rows_by_reading(server: Mosaicod) -> None:
    server.faults.version = "0.6.1"
    with connect(target(server)) as client:
        assert client.version == "0.6.1"
        assert client.limit_bytes == 50_000_000
    with ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/n", NUMBER, {}).write(numbers(3, 1))
    (contents,) = session.stored()
    assert (contents.rows, contents.start_ns, contents.end_ns) == (2, 1, 3)


class TestFaults:
    def test_topic_refused_by_server_keeps_other_topics(self, server: Mosaicod) -> None:
        server.faults.refuse["topic_create"] = [pa.ArrowInvalid("bad schema")]
        with ServerSink(target(server)).open("seq", {}) as session:
            with pytest.raises(SinkError, match="topic_create is refused: bad schema"):
                session.topic("/bad", NUMBER, {})
            session.topic("/good", NUMBER, {}).write(numbers(1))
        assert list(server.topics) == ["seq/good"]

    def test_upload_refused_fails_its_topic_and_keeps_others(self, server: Mosaicod) -> None:
        def refuse(topic: str, _: int) -> None:
            if topic == "seq/bad":
                raise pa.ArrowInvalid("no such column")

        server.faults.before_batch = refuse
        with ServerSink(target(server), buffer_bytes=0).open("seq", {}) as session:
            good, bad = session.topic("/good", NUMBER, {}), session.topic("/bad", NUMBER, {})
            good.write(numbers(1))
            with pytest.raises(SinkError, match="the upload of /bad is refused: no such column"):
                for at in range(200):
                    bad.write(numbers(at))
                    time.sleep(0.01)
            good.write(numbers(2))
            with pytest.raises(SinkError, match="no such column"):
                bad.write(numbers(3))
        assert [(topic.topic, topic.rows) for topic in session.stored()] == [("/good", 2), ("/bad", 0)]

    def test_session_with_only_failed_topic_is_deleted(self, server: Mosaicod) -> None:
        server.faults.refuse["do_put"] = [pa.ArrowInvalid("no room")]
        with ServerSink(target(server), buffer_bytes=0).open("seq", META) as session:
            writer = session.topic("/n", NUMBER, {})
            with pytest.raises(SinkError, match="the upload of /n is refused: no room"):
                for at in range(200):
                    writer.write(numbers(at))
                    time.sleep(0.01)
        assert (server.sequences, server.sessions, server.topics) == ({"seq": META}, {}, {})
        assert [topic.rows for topic in session.stored()] == [0]

    def test_upload_refused_at_close_deletes_sequence(self, server: Mosaicod) -> None:
        def refuse(topic: str, _: int) -> None:
            raise pa.ArrowInvalid(f"{topic} is odd")

        server.faults.before_batch = refuse
        with pytest.raises(SinkError, match="the upload of /n is refused: seq/n is odd"):
            write(server, 1)
        assert (server.sequences, server.topics) == ({}, {})

    def test_finalize_refused_deletes_sequence(self, server: Mosaicod) -> None:
        server.faults.refuse["session_finalize"] = [precondition("not now")]
        with pytest.raises(SinkError, match="session_finalize is refused: failed precondition: not now"):
            write(server, 1)
        assert (server.sequences, server.topics) == ({}, {})

    @pytest.mark.parametrize("action", ["sequence_create", "session_finalize"])
    def test_action_with_lost_response_is_not_repeated(self, server: Mosaicod, action: str) -> None:
        server.faults.lose_response[action] = 1
        write(server, 1, 2)
        assert server.topics["seq/n"].state == "final"
        assert server.calls.count(action) == 1

    @pytest.mark.parametrize("action", ["sequence_create", "session_finalize"])
    def test_action_unavailable_is_retried(self, server: Mosaicod, action: str) -> None:
        server.faults.refuse[action] = [fl.FlightUnavailableError("away")]
        write(server, 1, 2)
        assert server.topics["seq/n"].state == "final"

    def test_connect_to_starting_server_retries_handshake(self, server: Mosaicod) -> None:
        server.faults.refuse["info"] = [fl.FlightUnavailableError("starting")] * 2
        write(server, 1)
        assert server.calls.count("info") == 3

    def test_connect_to_slow_server_raises_after_timeout(self, server: Mosaicod) -> None:
        server.faults.response_delay_s = 0.5
        begin = time.monotonic()
        with (
            pytest.raises(SinkUnavailable, match="the server did not respond to info in time"),
            connect(target(server), response_s=0.1),
        ):
            pytest.fail("connected")
        assert time.monotonic() - begin < 2

    def test_upload_with_lost_connection_raises_retryable_error(
        self, server: Mosaicod, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("mosaico_ingest.destinations.server.client._DELAYS_S", (0.01,))
        proxy = Proxy(server.port)
        sink = ServerSink(target(proxy), buffer_bytes=0)
        with (
            pytest.raises(SinkUnavailable, match="the connection is refused") as caught,
            sink.open("seq", {}) as session,
        ):
            writer = session.topic("/n", NUMBER, {})
            writer.write(numbers(1))
            proxy.cut()
            for at in range(2, 200):
                writer.write(numbers(at))
                time.sleep(0.01)
        assert caught.value.retryable
        assert "an unfinished session of seq may remain on the server" in str(caught.value)

    def test_connect_retries_until_connection_is_restored(self, server: Mosaicod) -> None:
        proxy = Proxy(server.port)
        proxy.cut()
        threading.Timer(0.5, proxy.restore).start()
        with connect(target(proxy)) as client:
            assert client.find("seq") is None
        proxy.cut()


class TestKeys:
    def test_session_with_valid_key_stores_rows(self, server: Mosaicod) -> None:
        server.keys[make_key("w")] = "write"
        with ServerSink(target(server, api_key=make_key("w"))).open("seq", {}) as session:
            session.topic("/n", NUMBER, {}).write(numbers(1))
        assert session.stored()[0].rows == 1

    @pytest.mark.parametrize(
        ("key", "reason"),
        [
            (None, "the server requires an API key"),
            (make_key("other"), r"the API key is refused \(.*\) — check that the key belongs to this server"),
            (make_key("w")[:-1] + "?", "the API key is refused: it is not msco_"),
            (
                make_key("r"),
                "the API key has no permission for sequence_create .* — use a key with the permission write",
            ),
        ],
    )
    def test_session_with_refused_key_raises_without_retry(
        self, server: Mosaicod, key: str | None, reason: str
    ) -> None:
        server.keys.update({make_key("w"): "write", make_key("r"): "read"})
        with (
            pytest.raises(SinkError, match=reason) as caught,
            ServerSink(target(server, api_key=key)).open("s", {}),
        ):
            pytest.fail("opened")
        assert len(server.calls) <= 3
        assert not caught.value.retryable
        if key:
            assert key not in str(caught.value)
            assert key not in repr(caught.value.__cause__)

    def test_key_is_absent_from_repr_and_pickled_error(self, server: Mosaicod) -> None:
        server.keys[make_key("w")] = "write"
        key = make_key("wrong")
        sink = ServerSink(target(server, api_key=key))
        with pytest.raises(SinkError) as caught, sink.open("s", {}):
            pytest.fail("opened")
        assert key not in repr(sink)
        assert key.encode() not in pickle.dumps(caught.value)

    @pytest.mark.parametrize("key", ["msco_ü", "msco_\n", "a b"])
    def test_key_with_invalid_characters_raises_before_connecting(self, key: str) -> None:
        sink = ServerSink(ServerTarget("127.0.0.1", 1, api_key=key))
        with (
            pytest.raises(SinkError, match="the API key contains characters that are not allowed") as caught,
            sink.open("s", {}),
        ):
            pytest.fail("opened")
        assert key not in str(caught.value)

    @pytest.mark.parametrize(
        ("permission", "warned"), [("write", True), ("delete", False), ("manage", False)]
    )
    def test_preflight_key_without_delete_permission_warns(
        self, server: Mosaicod, permission: str, *, warned: bool
    ) -> None:
        server.keys[make_key("k")] = permission
        destination = ServerDestination(target(server, api_key=make_key("k")))
        findings = destination.preflight("seq", SessionLevelErrorPolicy.Delete)
        assert [finding.rule for finding in findings] == ["delete-permission"] * warned
        assert server.calls == ["info", "session_delete"]

    def test_preflight_unknown_key_raises(self, server: Mosaicod) -> None:
        server.keys[make_key("k")] = "write"
        with pytest.raises(SinkError, match="the API key is refused"):
            ServerDestination(target(server, api_key=make_key("other"))).preflight(
                "seq", SessionLevelErrorPolicy.Delete
            )

    def test_session_without_delete_permission_reports_remaining_session(self, server: Mosaicod) -> None:
        server.keys[make_key("w")] = "write"
        sink = ServerSink(target(server, api_key=make_key("w")))
        with (
            pytest.raises(
                SinkError, match=r"an unfinished session of seq remains on the server .*session_delete"
            ),
            sink.open("seq", {}) as session,
        ):
            session.topic("/n", NUMBER, {})
            raise SinkError("enough")


def test_open_existing_sequence_raises_sequence_exists(server: Mosaicod) -> None:
    write(server, 1)
    for choice in (IfExists.FAIL, IfExists.SKIP):
        with pytest.raises(SequenceExists, match=r"^seq: "):
            write(server, 2, if_exists=choice)


def test_connect_to_other_flight_server_raises() -> None:
    with (
        fl.FlightServerBase("grpc://127.0.0.1:0") as other,
        pytest.raises(SinkError, match="the Flight server at this address is not a Mosaico server"),
        connect(ServerTarget("127.0.0.1", other.port)),
    ):
        pytest.fail("connected")


class Babbling(Mosaicod):
    """A server whose handshake response is not JSON."""

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:  # noqa: ARG002 - Flight's signature
        yield b"\x0a\x05hello"


def test_connect_undecodable_response_raises() -> None:
    with (
        running(Babbling()) as server,
        pytest.raises(SinkError, match="the response to info cannot be decoded: Invalid JSON"),
        connect(target(server)),
    ):
        pytest.fail("connected")


def test_address_str_is_url_without_key() -> None:
    assert str(Address("::1", 6726, tls=True, key="secret")) == "grpc+tls://[::1]:6726"
    assert "secret" not in repr(Address("::1", 6726, tls=True, key="secret"))


def test_sink_upload_logs_nothing(server: Mosaicod, caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    with caplog.at_level(logging.DEBUG):
        write(server, 1)
    assert not caplog.records
    assert not list(tmp_path.iterdir())


def test_upload_to_stuck_server_raises_after_timeout_and_deletes_sequence(
    server: Mosaicod, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The timeout applies once, not once per topic."""
    monkeypatch.setattr("mosaico_ingest.destinations.server.session._UPLOAD_S", 0.3)
    monkeypatch.setattr("mosaico_ingest.destinations.server.session._LOCK_S", 0.2)
    going_on = threading.Event()
    server.faults.before_batch = lambda _topic, _number: going_on.wait(20) and None
    begin = time.monotonic()
    with (
        pytest.raises(SinkUnavailable, match="the server did not respond to the upload of /n in time"),
        ServerSink(target(server)).open("seq", META) as session,
    ):
        for topic in ("/n", "/m"):
            session.topic(topic, NUMBER, {}).write(numbers(1))
    assert time.monotonic() - begin < 4
    assert not server.sequences
    going_on.set()


def test_connect_interrupted_while_waiting_raises_keyboard_interrupt() -> None:
    # Background jobs of a shell ignore SIGINT, and their child processes inherit this.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        _interrupt_a_handshake()
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupt_a_handshake() -> None:
    begin = time.monotonic()
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent_target = ServerTarget("127.0.0.1", silent.getsockname()[1])
        with pytest.raises(KeyboardInterrupt), connect(silent_target):
            pytest.fail("connected")
    assert time.monotonic() - begin < 2.5
