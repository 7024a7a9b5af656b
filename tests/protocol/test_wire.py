from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol import (
    check_metadata,
    check_sequence_name,
    check_topic_name,
    key_problem,
    new_key,
)
from mosaico_ingest.protocol import (
    messages as actions,
)
from mosaico_ingest.protocol import (
    messages as bodies,
)
from mosaico_ingest.protocol.errors import (
    Condition,
    as_flight_error,
    condition_of,
    text_of,
)
from mosaico_ingest.protocol.messages import ACTIONS, JSON, Malformed, Permission


@pytest.mark.parametrize("name", ["run_1", "a@b", "~x", "-"])
def test_sequence_name_valid_is_accepted(name: str) -> None:
    assert check_sequence_name(name) == name


@pytest.mark.parametrize("name", ["", "a b", "a/b", "a:b", "a.b", "é", "50%", "a\n"])
def test_sequence_name_invalid_is_refused(name: str) -> None:
    with pytest.raises(SinkError):
        check_sequence_name(name)


@pytest.mark.parametrize("name", ["/imu", "imu", "/a/b", "/_hidden"])
def test_topic_name_valid_is_accepted(name: str) -> None:
    assert check_topic_name(name) == f"/{name.removeprefix('/')}"


@pytest.mark.parametrize("name", ["", "/", "//a", "/a/", "/a//b", "/a:b", "/a b", "/a.b"])
def test_topic_name_invalid_is_refused(name: str) -> None:
    with pytest.raises(SinkError):
        check_topic_name(name)


@pytest.mark.parametrize("metadata", [{"a.b": 1}, {"a": {"": 1}}, {"a": [{"x--y": 1}]}, {"a": float("nan")}])
def test_metadata_invalid_is_refused(metadata: dict[str, object]) -> None:
    with pytest.raises(SinkError, match="seq: metadata"):
        check_metadata(metadata, where="seq")


def test_request_bodies_have_exactly_the_documented_keys() -> None:
    put = bodies.Put(resource_locator="s/t", topic_uuid="u")
    assert json.loads(JSON.encode(put)) == {"resource_locator": "s/t", "topic_uuid": "u"}
    assert json.loads(JSON.encode(bodies.GetInfo(resource_locator="s"))) == {"resource_locator": "s"}
    created = bodies.SessionCreated(uuid="u", locator="s:1")
    answer = json.loads(JSON.encode_answer(actions.SESSION_CREATE, created))
    assert answer == {"action": "session_create", "response": {"uuid": "u", "locator": "s:1"}}
    nothing = json.loads(JSON.encode_answer(actions.SEQUENCE_CREATE, bodies.Empty()))
    assert nothing == {"action": "sequence_create", "response": None}


def test_metadata_round_trip_keeps_nulls() -> None:
    body = bodies.SequenceCreate(locator="s", user_metadata={"a": None, "b": [1, {"c": "ü"}]})
    assert JSON.decode(bodies.SequenceCreate, JSON.encode(body)) == body


def test_response_with_unknown_keys_is_decoded() -> None:
    data = b'{"action": "topic_create", "response": {"uuid": "u", "new": 1}, "later": 2}'
    assert JSON.decode_answer(actions.TOPIC_CREATE, data).uuid == "u"
    assert JSON.decode_answer(actions.SEQUENCE_CREATE, b"") == bodies.Empty()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b'{"action": "info", "response": {}}', "'info' instead of 'topic_create'"),
        (b'{"action": "topic_create", "response": null}', "uuid: Field required"),
        (b"{", "Invalid JSON"),
        (b"\xff", "Invalid JSON"),
    ],
)
def test_response_malformed_raises_with_the_reason(data: bytes, reason: str) -> None:
    with pytest.raises(Malformed, match=reason):
        JSON.decode_answer(actions.TOPIC_CREATE, data)


def reason_of(decode: Callable[[], object]) -> str:
    """Return why bytes are refused, or nothing."""
    try:
        decode()
    except Malformed as error:
        return str(error)
    return ""


@given(st.binary(), st.sampled_from(sorted(ACTIONS)))
def test_body_of_any_bytes_decodes_or_is_malformed(data: bytes, name: str) -> None:
    assert "\n" not in reason_of(lambda: JSON.decode(ACTIONS[name].question, data))
    assert "\n" not in reason_of(lambda: JSON.decode_answer(ACTIONS[name], data))


def test_permission_includes_lower_ones() -> None:
    assert Permission.MANAGE.includes(Permission.READ)
    assert Permission.WRITE.includes(Permission.WRITE)
    assert not Permission.WRITE.includes(Permission.DELETE)


def test_locator_round_trip_keeps_names() -> None:
    assert bodies.topic_locator("seq", "/a/b") == "seq/a/b"
    assert bodies.topic_name("seq/a/b") == "/a/b"
    assert bodies.session_locator("seq", "01J") == "seq:01J"


def test_api_key_new_is_valid_and_mistyped_is_not() -> None:
    key = new_key()
    assert key_problem(key) is None
    wrong = key[:5] + ("a" if key[5] != "a" else "b") + key[6:]
    assert key_problem(wrong) == "its checksum does not match, so at least one character is wrong"
    assert "msco_<" in str(key_problem("secret"))
    assert "secret" not in str(key_problem("secret"))


class Refusing(fl.FlightServerBase):
    """Answers every action with the condition it names."""

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> list[bytes]:  # noqa: ARG002 - Flight's signature
        raise as_flight_error(Condition(action.type), "the seq 'a' cannot")


@pytest.fixture(scope="module")
def refusing() -> Iterator[fl.FlightClient]:
    with Refusing("grpc://127.0.0.1:0") as server, fl.connect(f"grpc://127.0.0.1:{server.port}") as client:
        threading.Thread(target=server.serve, daemon=True).start()
        yield client


@pytest.mark.parametrize("condition", list(Condition))
def test_condition_round_trip_keeps_its_kind(refusing: fl.FlightClient, condition: Condition) -> None:
    with pytest.raises(pa.ArrowException) as caught:
        list(refusing.do_action(fl.Action(condition.value, b"")))
    assert condition_of(caught.value) is condition
    assert text_of(caught.value).endswith("the seq 'a' cannot")
