"""A small Mosaico server for tests: in memory, strict, with injected faults, and written from the protocol, not from our client."""

from __future__ import annotations

import json
import socket
import threading
import time
import uuid
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl

PERMISSIONS = ["read", "write", "delete", "manage"]


def make_key(name: str) -> str:
    """Return an API key in the format of Mosaico that depends only on the name."""
    secret = f"{name:x<32}"
    return f"msco_{secret}_{zlib.crc32(secret.encode()):08x}"


def exists(what: str) -> Exception:
    return fl.FlightServerError(f"{what} already exists")


def precondition(what: str) -> Exception:
    return fl.FlightServerError(f"failed precondition: {what}")


@dataclass
class Topic:
    locator: str
    tag: str
    format: str
    metadata: dict[str, Any]
    session: str
    uuid: str = field(default_factory=lambda: str(uuid.uuid4()))
    state: str = "created"
    schema: pa.Schema | None = None
    chunks: list[pa.RecordBatch] = field(default_factory=list)

    def table(self) -> pa.Table:
        return pa.Table.from_batches(self.chunks, self.schema)

    def info(self) -> dict[str, Any]:
        times = self.table().column("timestamp_ns").to_pylist()
        return {
            "created_at_ns": 1,
            "completed_at_ns": 2 if self.state == "final" else None,
            "locked": self.state == "final",
            "resource_locator": self.locator,
            "ontology_tag": self.tag,
            "serialization_format": self.format,
            "user_metadata": self.metadata,
            "data_info": {
                "interval": {"start_ns": min(times), "end_ns": max(times)} if times else None,
                "total_row_count": len(times),
                "total_bytes": sum(chunk.nbytes for chunk in self.chunks),
                "total_chunks_count": len(self.chunks),
            },
            "time_window_info": None,
        }


@dataclass
class Session:
    uuid: str
    locator: str
    sequence: str
    final: bool = False


@dataclass
class Faults:
    """Faults to inject; none by default."""

    refuse: dict[str, list[Exception]] = field(default_factory=dict)
    """Errors per action; each call raises the next one."""
    lose_response: dict[str, int] = field(default_factory=dict)
    """The number of calls per action that are executed but return `unavailable`."""
    before_batch: Callable[[str, int], None] = lambda _topic, _number: None
    version: str = "0.7.0"
    """Servers before 0.7 do not support `info` and return no counts."""
    response_delay_s: float = 0.0
    metadata_in_schema: bool = False
    """Servers before 0.7 send user metadata in the schema only."""
    total_bytes: int = -1
    """The stored size of each topic."""
    rows_sent: Callable[[Topic], fl.FlightDataStream] | None = None
    """Replaces the rows that `do_get` sends."""
    columns_sent: Callable[[Topic], pa.Schema] | None = None
    """Replaces the columns that `get_schema` sends."""
    refuse_open_sequences: bool = False
    """A sequence with an open session cannot be deleted."""


class Mosaicod(fl.FlightServerBase):
    """The server. `keys` maps API keys to permissions; if empty, all calls are allowed."""

    def __init__(
        self, location: str = "grpc://127.0.0.1:0", *, message_bytes: int = 50_000_000, **options: Any
    ) -> None:
        super().__init__(location, middleware={"key": _KeyFactory(self)}, **options)
        self.keys: dict[str, str] = {}
        self.faults = Faults()
        self.message_bytes = message_bytes
        self.sequences: dict[str, dict[str, Any]] = {}
        self.sessions: dict[str, Session] = {}
        self.topics: dict[str, Topic] = {}
        self.notes: dict[str, list[str]] = defaultdict(list)
        self.calls: list[str] = []
        self.bodies: list[tuple[str, dict[str, Any]]] = []

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:
        body: dict[str, Any] = json.loads(action.body.to_pybytes())
        self.calls.append(action.type)
        self.bodies.append((action.type, body))
        self._check_permission(context, action.type)
        time.sleep(self.faults.response_delay_s)
        if self.faults.refuse.get(action.type):
            raise self.faults.refuse[action.type].pop(0)
        handler = getattr(self, f"_{action.type}", None)
        if handler is None or (action.type == "info" and self.faults.version < "0.7"):
            raise pa.ArrowInvalid(f"unknown action {action.type}")
        response = handler(**body)
        if self.faults.lose_response.get(action.type):
            self.faults.lose_response[action.type] -= 1
            raise fl.FlightUnavailableError("connection reset")
        yield json.dumps({"action": action.type, "response": response}).encode()

    def _info(self) -> dict[str, Any]:
        sizes = (
            "grpc_max_decode_message_size",
            "grpc_max_encode_message_size",
            "grpc_target_encode_message_size",
        )
        return {
            "version": self.faults.version,
            "semver": {"major": 0, "minor": 7, "patch": 0, "pre": None},
            "config": dict.fromkeys(sizes, self.message_bytes),
        }

    def _version(self) -> dict[str, Any]:
        return {"version": self.faults.version}

    def _sequence_create(self, locator: str, user_metadata: dict[str, Any]) -> None:
        if locator in self.sequences:
            raise exists(f"sequence {locator}")
        self.sequences[locator] = user_metadata

    def _session_create(self, locator: str) -> dict[str, Any]:
        if locator not in self.sequences:
            raise pa.ArrowKeyError(f"sequence {locator} not found")
        session = Session(str(uuid.uuid4()), f"{locator}:{uuid.uuid4().hex[:26]}", locator)
        self.sessions[session.uuid] = session
        return {"uuid": session.uuid, "locator": session.locator}

    def _topic_create(
        self,
        session_uuid: str,
        locator: str,
        serialization_format: str,
        ontology_tag: str,
        user_metadata: dict[str, Any],
    ) -> dict[str, Any]:
        session = self.sessions[session_uuid]
        if session.final or not locator.startswith(f"{session.sequence}/"):
            raise fl.FlightUnauthorizedError("session mismatch")
        if locator in self.topics:
            raise exists(f"topic {locator}")
        topic = Topic(locator, ontology_tag, serialization_format, user_metadata, session_uuid)
        self.topics[locator] = topic
        return {"uuid": topic.uuid}

    def _session_finalize(self, session_uuid: str) -> None:
        session = self.sessions[session_uuid]
        topics = [topic for topic in self.topics.values() if topic.session == session_uuid]
        if session.final:
            raise precondition("the session is finalized already")
        if not topics:
            raise precondition("the session is empty")
        for topic in topics:
            if topic.state != "uploaded":
                raise precondition(f"{topic.locator} is {topic.state}")
        for topic in topics:
            topic.state = "final"
        session.final = True

    def _session_delete(self, locator: str) -> None:
        sessions = [session for session in self.sessions.values() if session.locator == locator]
        if not sessions:
            raise pa.ArrowKeyError(f"session {locator} not found")
        del self.sessions[sessions[0].uuid]
        self.topics = {
            name: topic for name, topic in self.topics.items() if topic.session != sessions[0].uuid
        }

    def _topic_delete(self, locator: str) -> None:
        self.topics.pop(locator)

    def _sequence_delete(self, locator: str) -> None:
        if self.faults.refuse_open_sequences and any(
            not session.final for session in self.sessions.values() if session.sequence == locator
        ):
            raise precondition(f"{locator} has an open session")
        if self.sequences.pop(locator, None) is None:
            raise pa.ArrowKeyError(f"sequence {locator} not found")
        self.sessions = {
            key: session for key, session in self.sessions.items() if session.sequence != locator
        }
        self.topics = {key: topic for key, topic in self.topics.items() if key.partition("/")[0] != locator}
        self.notes.pop(locator, None)

    def _sequence_notification_create(self, locator: str, notification_type: str, msg: str) -> None:
        assert notification_type == "error"
        self.notes[locator].append(msg)

    def _sequence_notification_list(self, locator: str) -> dict[str, Any]:
        return {
            "notifications": [
                {"name": locator, "notification_type": "error", "msg": text, "created_datetime": "2026-01-01"}
                for text in self.notes.get(locator, ())
            ]
        }

    _topic_notification_create = _sequence_notification_create

    def do_put(
        self,
        context: fl.ServerCallContext,
        descriptor: fl.FlightDescriptor,
        reader: fl.MetadataRecordBatchReader,
        writer: fl.FlightMetadataWriter,  # noqa: ARG002 - Flight's signature
    ) -> None:
        self.calls.append("do_put")
        self._check_permission(context, "do_put")
        if self.faults.refuse.get("do_put"):
            raise self.faults.refuse["do_put"].pop(0)
        command = json.loads(descriptor.command)
        assert set(command) == {"resource_locator", "topic_uuid"}
        topic = self.topics[command["resource_locator"]]
        if topic.uuid != command["topic_uuid"]:
            raise fl.FlightUnauthorizedError("uuid mismatch")
        if topic.state != "created":
            raise precondition(f"{topic.locator} is {topic.state}")
        topic.state = "uploading"
        topic.schema = reader.schema
        assert reader.schema.field("timestamp_ns").type == pa.int64()
        for number, chunk in enumerate(reader):
            self.faults.before_batch(topic.locator, number)
            if pa.ipc.get_record_batch_size(chunk.data) > self.message_bytes:
                raise fl.FlightServerError("out_of_range: message length too large")
            if chunk.data.num_rows:
                topic.chunks.append(chunk.data)
        topic.state = "uploaded"

    def get_flight_info(
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.FlightInfo:
        self.calls.append("get_flight_info")
        self._check_permission(context, "get_flight_info")
        locator = json.loads(descriptor.command)["resource_locator"]
        sequence = locator.partition("/")[0]
        if sequence not in self.sequences or ("/" in locator and locator not in self.topics):
            raise pa.ArrowKeyError(f"{locator} not found")
        endpoints = [
            fl.FlightEndpoint(name.encode(), [], None, self._endpoint(topic))
            for name, topic in self.topics.items()
            if name == locator or name.startswith(f"{locator}/")
        ]
        sessions = [
            {
                "locator": session.locator,
                "created_at_ns": 1,
                "locked": session.final,
                "topics": [name for name, topic in self.topics.items() if topic.session == key],
            }
            for key, session in self.sessions.items()
            if session.sequence == sequence
        ]
        description = {
            "resource_locator": sequence,
            "created_at_ns": 1,
            "user_metadata": self.sequences[sequence],
            "sessions": sessions,
        }
        schema = pa.schema([])
        if locator in self.topics and self.faults.version < "0.7":
            topic = self.topics[locator]
            properties = {"ontology_tag": topic.tag, "serialization_format": topic.format}
            metadata = {"mosaico:properties": properties, "mosaico:user_metadata": topic.metadata}
            schema = schema.with_metadata({key: json.dumps(value) for key, value in metadata.items()})
        elif self.faults.metadata_in_schema:
            metadata = json.dumps(description.pop("user_metadata"))
            schema = schema.with_metadata({"mosaico:user_metadata": metadata})
        total_bytes = self.faults.total_bytes if locator in self.topics else -1
        return fl.FlightInfo(
            schema, descriptor, endpoints, -1, total_bytes, app_metadata=json.dumps(description).encode()
        )

    def get_schema(self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor) -> fl.SchemaResult:
        self._check_permission(context, "get_flight_info")
        topic = self.topics[json.loads(descriptor.command)["resource_locator"]]
        stream = self.faults.columns_sent
        return fl.SchemaResult(topic.schema if stream is None else stream(topic))

    def do_get(self, context: fl.ServerCallContext, ticket: fl.Ticket) -> fl.RecordBatchStream:
        self._check_permission(context, "do_get")
        topic = self.topics[ticket.ticket.decode()]
        if self.faults.rows_sent is not None:
            return self.faults.rows_sent(topic)
        return fl.RecordBatchStream(topic.table())

    def _endpoint(self, topic: Topic) -> bytes:
        return b"{}" if self.faults.version < "0.7" else json.dumps(topic.info()).encode()

    def _check_permission(self, context: fl.ServerCallContext, call: str) -> None:
        if not self.keys:
            return
        key = context.get_middleware("key").key
        if key is None:
            raise fl.FlightUnauthenticatedError("missing API key")
        if key not in self.keys:
            raise fl.FlightUnauthenticatedError(f"unknown key {key}")
        needed = (
            "read"
            if call in {"info", "version", "get_flight_info", "do_get", "sequence_notification_list"}
            else "delete"
            if call.endswith(("_delete", "_purge"))
            else "write"
        )
        if PERMISSIONS.index(self.keys[key]) < PERMISSIONS.index(needed):
            raise fl.FlightUnauthorizedError(f"{call} needs {needed}")


class _Key(fl.ServerMiddleware):
    def __init__(self, key: str | None) -> None:
        self.key = key


class _KeyFactory(fl.ServerMiddlewareFactory):
    def __init__(self, server: Mosaicod) -> None:
        self.server = server

    def start_call(self, info: fl.CallInfo, headers: dict[str, list[str]]) -> _Key:  # noqa: ARG002 - Flight's signature
        return _Key(headers.get("mosaico-api-key-token", [None])[0])


@contextmanager
def running(server: Mosaicod) -> Iterator[Mosaicod]:
    """Serve in a thread until the block ends."""
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()


class Proxy:
    """A TCP proxy to a server whose connections can be cut and restored."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._pairs: list[socket.socket] = []
        self._listen(0)

    def _listen(self, port: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        """Close all connections and refuse new ones."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for end in self._pairs:
            with end, suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        self._pairs.clear()

    def restore(self) -> None:
        """Accept connections again."""
        self._listen(self.port)

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                near, _ = listener.accept()
            except OSError:
                return
            far = socket.create_connection(("127.0.0.1", self._target))
            self._pairs += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    @staticmethod
    def _pump(source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            return
