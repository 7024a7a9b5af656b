"""Comparison of the calls that both injectors send to a server."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow as pa
import pyarrow.flight as fl
import pytest

from mosaico_ingest.api import RosbagInjector
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.ontology.registry import fingerprint
from mosaico_ingest.serve.server import Service

pytestmark = pytest.mark.interop
pytest.importorskip("mosaicolabs", reason="the official SDK is not installed")

RECORDING = Path(__file__).resolve().parents[2] / "configs/quickstart/drive.mcap"


@dataclass
class Traffic:
    """What one client said."""

    actions: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    """Name, and the keys of the body."""
    uploads: dict[str, tuple[str, int, int]] = field(default_factory=dict)
    """By topic: the fingerprint of its columns, rows, messages."""
    created: dict[str, object] = field(default_factory=dict)
    """By topic: the body that announced it, without its UUID."""


class Recorder(Service):
    """Our server, which also writes down what it hears."""

    heard = Traffic()

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:
        body = json.loads(action.body.to_pybytes())
        self.heard.actions.append((action.type, tuple(sorted(body))))
        if action.type == "topic_create":
            self.heard.created[body["locator"].partition("/")[2]] = {
                key: value for key, value in body.items() if key not in {"session_uuid", "locator"}
            }
        return super().do_action(context, action)

    def do_put(
        self,
        context: fl.ServerCallContext,
        descriptor: fl.FlightDescriptor,
        reader: fl.MetadataRecordBatchReader,
        writer: fl.FlightMetadataWriter,
    ) -> None:
        command = json.loads(descriptor.command)
        assert sorted(command) == ["resource_locator", "topic_uuid"]
        batches = [chunk.data for chunk in reader]
        payload = pa.struct([column for column in reader.schema if column.name != "timestamp_ns"])
        topic = command["resource_locator"].partition("/")[2]
        rows = sum(batch.num_rows for batch in batches)
        self.heard.uploads[topic] = (fingerprint(payload), rows, len(batches))
        super().do_put(context, descriptor, _Replay(reader.schema, batches), writer)  # type: ignore[arg-type] - it reads like one


class _Replay:
    """Batches that were read already, as a reader."""

    def __init__(self, schema: pa.Schema, batches: list[pa.RecordBatch]) -> None:
        self.schema = schema
        self._batches = batches

    def __iter__(self) -> Iterator[fl.FlightStreamChunk]:
        return iter(_Chunk(batch) for batch in self._batches)


@dataclass(frozen=True)
class _Chunk:
    data: pa.RecordBatch


@pytest.fixture(scope="module")
def traffic(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Traffic, Traffic]]:
    """What our injector said, and what the official one said, about the same recording."""
    store = Store.open(tmp_path_factory.mktemp("heard"))
    server = Recorder(store, "grpc://127.0.0.1:0", keyring=None, certificates=None, request_s=60.0)
    ours = server.heard = Traffic()
    topics = "!/camera/image_raw"  # the SDK makes PNGs of these
    config = ROSInjectionConfig(RECORDING, "ours", host="127.0.0.1", port=server.port, topics=(topics,))
    RosbagInjector(config).run()
    theirs = server.heard = Traffic()
    injector = Path(sys.executable).with_name("mosaicolabs.ros_injector")
    command = [
        str(injector),
        str(RECORDING),
        "--name",
        "theirs",
        "--port",
        str(server.port),
        "--topics",
        topics,
    ]
    subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - the SDK's own command
    yield ours, theirs
    server.shutdown()
    server.discard_unfinished()


def test_both_injectors_make_the_same_calls_with_the_same_keys(traffic: tuple[Traffic, Traffic]) -> None:
    """The handshake aside, which older SDKs make by `version`."""
    ours, theirs = (
        [call for call in output.actions if call[0] not in {"info", "version"}] for output in traffic
    )
    assert Counter(ours) == Counter(theirs)
    for calls in (ours, theirs):
        names = [name for name, _ in calls]
        assert names[:2] == ["sequence_create", "session_create"]
        assert names[-1] == "session_finalize"


def test_both_injectors_create_the_same_topics(traffic: tuple[Traffic, Traffic]) -> None:
    ours, theirs = traffic
    compressed = ours.created["camera/image_raw/compressed"]
    assert isinstance(compressed, dict)
    assert compressed["user_metadata"].pop("ros_format")  # what the message says beyond the codec is kept
    assert ours.created == theirs.created


def test_both_injectors_upload_equal_rows_and_ours_fewer_messages(
    traffic: tuple[Traffic, Traffic],
) -> None:
    ours, theirs = traffic
    assert {topic: output[:2] for topic, output in ours.uploads.items()} == {
        topic: output[:2] for topic, output in theirs.uploads.items()
    }
    assert sum(output[2] for output in ours.uploads.values()) <= sum(
        output[2] for output in theirs.uploads.values()
    )
