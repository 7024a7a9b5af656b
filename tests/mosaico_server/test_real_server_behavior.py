"""Behavior of real servers that the protocol does not state: message sizes, metadata forms and broken streams."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from hollow_batches import hollow_batch, malformed_batch
from mosaicod import Mosaicod, Topic, running

from mosaico_ingest.destinations import destination_of, has_nested_lists, topic_schema, validated
from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.destinations.server.destination import ServerSink
from mosaico_ingest.errors import SinkError, SinkUnavailable
from mosaico_ingest.job.values import IfExists, ServerTarget, SessionLevelErrorPolicy
from mosaico_ingest.ontology.registry import MODULES, OntologyType, ontology_type

BLOB = OntologyType("Blob", pa.struct([pa.field("data", pa.binary())]))
NESTED = OntologyType("Nested", pa.struct([pa.field("a", pa.list_(pa.list_(pa.list_(pa.int8()))))]))
TYPES = [*map(ontology_type, sorted(MODULES)), NESTED]


@pytest.fixture
def server() -> Iterator[Mosaicod]:
    with running(Mosaicod()) as server:
        yield server


def target(server: Mosaicod, **options: Any) -> ServerTarget:
    return ServerTarget("127.0.0.1", server.port, **options)


def blobs(*sizes: int) -> pa.RecordBatch:
    columns = [pa.array(range(len(sizes)), pa.int64()), pa.array([b"x" * size for size in sizes])]
    return pa.RecordBatch.from_arrays(columns, schema=topic_schema(BLOB))


def write(server: Mosaicod, *sizes: int, if_exists: IfExists = IfExists.FAIL, **options: Any) -> None:
    with ServerSink(target(server, **options)).open("seq", {"car": 7}, if_exists=if_exists) as session:
        session.topic("/b", BLOB, {}).write(blobs(*sizes))


def received(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return the batch as it arrives in another process."""
    stream = io.BytesIO()
    with pa.ipc.new_stream(stream, batch.schema) as writer:
        writer.write_batch(batch)
    return pa.ipc.open_stream(stream.getvalue()).read_next_batch()


@pytest.mark.parametrize(
    ("options", "largest"), [({}, 10_000_000), ({"message_bytes": 3_000_000}, 3_000_000)]
)
def test_upload_of_many_rows_sends_messages_up_to_target_size(
    server: Mosaicod, options: dict[str, int], largest: int
) -> None:
    write(server, *[900_000] * 30, **options)
    sizes = [pa.ipc.get_record_batch_size(chunk) for chunk in server.topics["seq/b"].chunks]
    assert max(sizes) <= largest
    assert len(sizes) == -(-30 // (largest // 900_100))


def test_upload_of_row_above_target_size_sends_it_alone(server: Mosaicod) -> None:
    write(server, 10, 30_000_000, 10)
    assert [chunk.num_rows for chunk in server.topics["seq/b"].chunks] == [1, 1, 1]


@pytest.mark.parametrize("if_exists", [IfExists.FAIL, IfExists.REPLACE])
def test_upload_of_row_near_limit_is_rejected_before_commit(server: Mosaicod, if_exists: IfExists) -> None:
    if if_exists is IfExists.REPLACE:
        write(server, 5)
    with pytest.raises(SinkError) as raised:
        write(server, 10, 47_000_000, if_exists=if_exists)
    assert raised.value.where == "/b"
    assert "row of 1 ns" in raised.value.what
    assert len(server.topics) == (if_exists is IfExists.REPLACE)


def test_upload_of_row_that_can_be_sent_back_is_accepted(server: Mosaicod) -> None:
    write(server, 39_000_000)
    assert server.topics["seq/b"].table().num_rows == 1


def test_client_without_announced_limit_assumes_50_000_000_bytes(server: Mosaicod) -> None:
    server.faults.version = "0.6.0"
    with connect(target(server)) as client:
        assert client.limit_bytes == 50_000_000


@pytest.mark.parametrize("in_schema", [False, True])
def test_find_reads_user_metadata_in_both_forms(server: Mosaicod, *, in_schema: bool) -> None:
    write(server, 1)
    server.faults.metadata_in_schema = in_schema
    existing = destination_of(target(server)).find("seq")
    assert existing is not None
    assert (existing.sessions[0].metadata, existing.complete) == ({"car": 7}, True)


def test_stored_size_is_total_bytes_of_server(server: Mosaicod) -> None:
    server.faults.version = "0.6.0"
    server.faults.total_bytes = 1234
    with ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/b", BLOB, {}).write(blobs(1, 2))
    (stored,) = session.stored()
    assert (stored.rows, stored.stored_bytes) == (2, 1234)


def test_stored_with_stream_that_breaks_is_destination_error_with_state(server: Mosaicod) -> None:
    def breaking(topic: Topic) -> fl.FlightDataStream:
        def batches() -> Iterator[pa.RecordBatch]:
            yield topic.chunks[0]
            raise OSError("Stream removed")

        return fl.GeneratorStream(topic.schema, batches())

    server.faults.version = "0.6.0"
    server.faults.rows_sent = breaking
    with ServerSink(target(server)).open("seq", {}) as session:
        session.topic("/b", BLOB, {}).write(blobs(1, 2))
    with pytest.raises(SinkError) as raised:
        session.stored()
    assert raised.value.exit_code == 1
    assert "finalized" in (raised.value.hint or "")


def test_client_call_that_fails_with_os_error_is_unavailable(server: Mosaicod) -> None:
    def fail() -> None:
        raise OSError("Stream removed")

    with connect(target(server)) as client, pytest.raises(SinkUnavailable):
        client._once(fail, "do_get", needs=None)  # type: ignore[arg-type]


@pytest.mark.parametrize("refused", [False, True])
def test_replace_after_killed_upload_deletes_open_session(server: Mosaicod, *, refused: bool) -> None:
    server._sequence_create("seq", {"car": 7})
    server._session_create("seq")
    server.faults.refuse_open_sequences = refused
    existing = destination_of(target(server)).find("seq")
    assert existing is not None
    assert not existing.complete
    write(server, 3, if_exists=IfExists.REPLACE)
    assert server.topics["seq/b"].table().num_rows == 1
    assert [each.final for each in server.sessions.values()] == [True]


def test_replace_keeps_stored_sequence_while_rows_are_written(server: Mosaicod) -> None:
    write(server, 1, 2)
    with ServerSink(target(server)).open("seq", {}, if_exists=IfExists.REPLACE) as session:
        session.topic("/b", BLOB, {}).write(blobs(3))
        assert server.topics["seq/b"].table().num_rows == 2
    assert server.topics["seq/b"].table().num_rows == 1
    assert [topic.rows for topic in session.stored()] == [1]


@pytest.mark.parametrize(("version", "rules"), [("0.5.2", ["old-server"]), ("0.6.0", []), ("0.7.0", [])])
def test_preflight_warns_about_servers_before_0_6(server: Mosaicod, version: str, rules: list[str]) -> None:
    server.faults.version = version
    findings = destination_of(target(server)).preflight("seq", SessionLevelErrorPolicy.Report)
    assert [finding.rule for finding in findings] == rules
    assert all(version in finding.message for finding in findings)


@pytest.mark.parametrize("ontology", TYPES, ids=lambda ontology: ontology.tag)
@pytest.mark.parametrize("rows", [0, 1, 3])
def test_validated_batch_without_offsets_can_be_measured(ontology: OntologyType, rows: int) -> None:
    batch = received(hollow_batch(topic_schema(ontology), rows))
    complete = validated(batch)
    assert complete.nbytes >= 8 * rows
    assert complete.equals(batch)
    complete.validate(full=True)


def test_batch_without_offsets_crashes_unless_validated() -> None:
    """Prove that the batches of the other tests crash without validation."""
    script = Path(__file__).with_name("measure_hollow_batch.py")
    outcomes = [
        subprocess.run([sys.executable, script, how], check=False).returncode  # noqa: S603 - our own script
        for how in ("received", "validated")
    ]
    assert outcomes[0] < 0
    assert outcomes[1] == 0


@pytest.mark.parametrize("ontology", TYPES, ids=lambda ontology: ontology.tag)
@pytest.mark.parametrize("if_exists", [IfExists.FAIL, IfExists.REPLACE])
def test_upload_and_count_of_batches_without_offsets(
    server: Mosaicod, ontology: OntologyType, if_exists: IfExists
) -> None:
    hollow = [received(hollow_batch(topic_schema(ontology), rows)) for rows in (0, 2)]
    if if_exists is IfExists.REPLACE:
        write(server, 1)
    server.faults.version = "0.6.0"
    server.faults.rows_sent = lambda topic: fl.GeneratorStream(topic.schema, iter(hollow))
    with ServerSink(target(server)).open("seq", {}, if_exists=if_exists) as session:
        writer = session.topic("/t", ontology, {})
        for batch in hollow:
            writer.write(batch)
    assert [(topic.rows, topic.end_ns) for topic in session.stored()] == [(2, 1)]


def test_has_nested_lists_finds_lists_inside_lists() -> None:
    def schema(kind: pa.DataType) -> pa.Schema:
        return pa.schema([("a", kind)])

    assert has_nested_lists(schema(pa.list_(pa.struct([("b", pa.list_(pa.int8()))]))))
    assert not has_nested_lists(schema(pa.struct([("b", pa.list_(pa.int8()))])))


def test_validated_batch_with_offsets_out_of_range_is_refused() -> None:
    with pytest.raises(pa.ArrowInvalid):
        validated(malformed_batch())
