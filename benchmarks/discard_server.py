"""A Mosaico server that discards all rows, to measure clients: print the port, serve until standard input is closed.

It implements only the calls of an upload by the official client, so that nearly all of the measured time is the client's.
"""

from __future__ import annotations

import json
import sys
import threading
import uuid
from collections.abc import Iterator
from typing import Any, TypeAlias

import pyarrow as pa
import pyarrow.flight as fl

MESSAGE_BYTES = 50 << 20
"""The default message limit of a Mosaico server, in bytes."""
SIZES = ("grpc_max_decode_message_size", "grpc_max_encode_message_size", "grpc_target_encode_message_size")

Call: TypeAlias = Any
Descriptor: TypeAlias = Any
Upload: TypeAlias = Any
"""Arguments of Flight handlers, whose classes have no annotations."""


class DiscardServer(fl.FlightServerBase):
    """A server that accepts every upload and counts its rows."""

    def __init__(self) -> None:
        super().__init__("grpc://127.0.0.1:0")
        self.topics: dict[str, dict[str, Any]] = {}
        self.sessions: list[str] = []

    def do_action(self, _context: Call, action: fl.Action) -> Iterator[bytes]:
        request: dict[str, Any] = json.loads(action.body.to_pybytes() or b"{}")
        response: dict[str, Any] | None = None
        if action.type == "info":
            response = {
                "version": "0.7.0",
                "semver": {"major": 0, "minor": 7, "patch": 0, "pre": None},
                "config": dict.fromkeys(SIZES, MESSAGE_BYTES),
            }
        elif action.type in {"session_create", "topic_create"}:
            identifier = str(uuid.uuid4())
            response = {"uuid": identifier}
            if action.type == "session_create":
                response["locator"] = f"{request['locator']}:{identifier[:8]}"
                self.sessions.append(response["locator"])
            else:
                self.topics[identifier] = {**request, "rows": 0, "bytes": 0, "low": None, "high": None}
        elif action.type.endswith("notification_list"):
            response = {"notifications": []}
        if response is None:
            yield json.dumps({"action": "empty"}).encode()
        else:
            yield json.dumps({"action": action.type, "response": response}).encode()

    def do_put(self, _context: Call, descriptor: Descriptor, reader: Upload, _writer: Call) -> None:
        topic = self.topics[json.loads(descriptor.command)["topic_uuid"]]
        for chunk in reader:
            times = chunk.data.column("timestamp_ns").to_numpy()
            if len(times):
                topic["rows"] += len(times)
                topic["bytes"] += chunk.data.nbytes
                topic["low"] = min(int(times[0]), topic["low"] or int(times[0]))
                topic["high"] = max(int(times[-1]), topic["high"] or 0)

    def get_flight_info(self, _context: Call, descriptor: Descriptor) -> fl.FlightInfo:
        locator = json.loads(descriptor.command)["resource_locator"]
        endpoints = [
            fl.FlightEndpoint(identifier.encode(), [], None, json.dumps(_topic_info(topic)).encode())
            for identifier, topic in self.topics.items()
            if topic["locator"].startswith(f"{locator}/")
        ]
        topics = [topic["locator"] for topic in self.topics.values()]
        finished = {"created_at_ns": 1, "completed_at_ns": 1, "locked": True, "topics": topics}
        sessions = [{"locator": session, **finished} for session in self.sessions]
        description = {
            "resource_locator": locator,
            "created_at_ns": 1,
            "user_metadata": {},
            "sessions": sessions,
        }
        metadata = json.dumps(description).encode()
        return fl.FlightInfo(pa.schema([]), descriptor, endpoints, -1, -1, False, metadata)  # noqa: FBT003 - pyarrow has no name for it


def _topic_info(topic: dict[str, Any]) -> dict[str, Any]:
    return {
        "created_at_ns": 1,
        "completed_at_ns": 1,
        "locked": True,
        "resource_locator": topic["locator"],
        "ontology_tag": topic["ontology_tag"],
        "serialization_format": topic["serialization_format"],
        "user_metadata": topic["user_metadata"],
        "data_info": {
            "total_bytes": topic["bytes"],
            "total_chunks_count": 1,
            "total_row_count": topic["rows"],
            "interval": {"start_ns": topic["low"], "end_ns": topic["high"]},
        },
    }


def main() -> None:
    server = DiscardServer()
    threading.Thread(target=server.serve, daemon=True).start()
    print(server.port, flush=True)
    sys.stdin.read()
    print(sum(topic["rows"] for topic in server.topics.values()), flush=True)
    server.shutdown()


if __name__ == "__main__":
    main()
