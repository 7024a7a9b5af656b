"""A minimal Flight client that sends requests and returns responses unchanged."""

from __future__ import annotations

import json
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest.protocol.errors import Condition, condition_of, text_of
from mosaico_ingest.protocol.messages import API_KEY_HEADER
from mosaico_ingest.serve import Server


class Client:
    """A client of a server, with or without an API key."""

    def __init__(self, server: Server, key: str | None = None, **options: Any) -> None:
        self.flight = fl.connect(server.location, **options)
        headers = [] if key is None else [(API_KEY_HEADER.encode(), key.encode())]
        self.options = fl.FlightCallOptions(headers=headers, timeout=20)

    def __enter__(self) -> Client:  # noqa: PYI034 - Self comes with Python 3.11
        return self

    def __exit__(self, *_: object) -> None:
        self.flight.close()

    def call(self, name: str, **body: Any) -> Any:
        action = fl.Action(name, json.dumps(body).encode())
        data = b"".join(result.body.to_pybytes() for result in self.flight.do_action(action, self.options))
        response = json.loads(data)
        assert response["action"] == name
        return response["response"]

    def put(self, locator: str, uuid: str, *batches: pa.RecordBatch, schema: pa.Schema | None = None) -> None:
        descriptor = descriptor_of(resource_locator=locator, topic_uuid=uuid)
        writer, _ = self.flight.do_put(descriptor, schema or batches[0].schema, self.options)
        for batch in batches:
            writer.write_batch(batch)
        writer.done_writing()
        writer.close()

    def info(self, locator: str, **more: Any) -> tuple[Any, list[Any]]:
        info = self.flight.get_flight_info(descriptor_of(resource_locator=locator, **more), self.options)
        endpoints = [json.loads(endpoint.app_metadata) for endpoint in info.endpoints]
        return json.loads(info.app_metadata or b"null"), endpoints

    def rows(self, locator: str, **more: Any) -> list[int]:
        info = self.flight.get_flight_info(descriptor_of(resource_locator=locator, **more), self.options)
        (endpoint,) = info.endpoints
        return self.flight.do_get(endpoint.ticket, self.options).read_all()["timestamp_ns"].to_pylist()

    def upload(self, sequence: str, topic: str, *batches: pa.RecordBatch, tag: str = "Sample") -> None:
        session = self.call("session_create", locator=sequence)["uuid"]
        uuid = self.create_topic(session, f"{sequence}{topic}", tag=tag)
        self.put(f"{sequence}{topic}", uuid, *batches)
        self.call("session_finalize", session_uuid=session)

    def create_topic(self, session: str, locator: str, *, tag: str = "Sample", **metadata: Any) -> str:
        return self.call(
            "topic_create",
            session_uuid=session,
            locator=locator,
            serialization_format="default",
            ontology_tag=tag,
            user_metadata=metadata,
        )["uuid"]


def descriptor_of(**command: Any) -> fl.FlightDescriptor:
    return fl.FlightDescriptor.for_command(json.dumps(command).encode())


class refused:  # noqa: N801 - used like pytest.raises
    """Expect a call to fail with a condition and, optionally, a word in the message."""

    def __init__(self, condition: Condition, word: str = "") -> None:
        self.condition = condition
        self.word = word

    def __enter__(self) -> None: ...

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        assert error is not None, f"expected {self.condition}"
        assert (condition_of(error), self.word in text_of(error)) == (self.condition, True), str(error)
        return True
