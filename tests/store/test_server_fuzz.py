"""Any request returns a response or a refusal, never an internal error."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa
import pyarrow.flight as fl
import pytest
from flight_calls import Client
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.protocol.errors import Condition, condition_of
from mosaico_ingest.protocol.messages import ACTIONS
from mosaico_ingest.serve import serve

Rows = Callable[..., pa.RecordBatch]

FIELDS = {
    "locator": st.sampled_from(["drive", "drive/imu", "drive:01ABC", "new", "new/imu", "../x", "a" * 5000]),
    "session_uuid": st.text(max_size=8),
    "user_metadata": st.dictionaries(st.text(max_size=4), st.text(max_size=4), max_size=2),
    "serialization_format": st.sampled_from(["default", "image", "odd"]),
    "ontology_tag": st.text(max_size=4),
    "notification_type": st.just("error"),
    "msg": st.text(max_size=20),
    "timestamp_ns_start": st.integers(),
    "timestamp_ns_end": st.integers(),
    "resource_locator": st.sampled_from(["drive", "drive/imu", "x"]),
    "topic_uuid": st.text(max_size=4),
    "sequence": st.dictionaries(st.sampled_from(["name", "created_at_ns", "user_metadata"]), st.none()),
}
OPERATORS = st.sampled_from(
    [
        "$eq",
        "$neq",
        "$lt",
        "$leq",
        "$gt",
        "$geq",
        "$between",
        "$outside",
        "$in",
        "$match",
        "$ex",
        "$nex",
        "$odd",
    ]
)
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)
BODIES = st.fixed_dictionaries({}, optional={name: values | ANYTHING for name, values in FIELDS.items()})


@pytest.fixture(scope="module")
def caller(tmp_path_factory: pytest.TempPathFactory, rows: Rows, sample: OntologyType) -> Iterator[Client]:
    folder = tmp_path_factory.mktemp("fuzzed")
    with StoreSink(Store.open(folder)).open("drive", {}) as session:
        session.topic("/imu", sample, {}).write(rows([1, 2, 3]))
    with serve(folder, port=0) as server, Client(server) as client:
        yield client


def refused_or_answered(call: Callable[[], object]) -> None:
    try:
        call()
    except (fl.FlightError, pa.ArrowException, KeyError) as err:
        assert condition_of(err) is not Condition.INTERNAL, str(err)  # noqa: PT017 - what is raised is what is tested


@settings(max_examples=150)
@given(name=st.sampled_from(sorted(set(ACTIONS) - {"sequence_delete", "topic_delete"})), body=BODIES)
def test_action_with_any_body_has_no_internal_error(caller: Client, name: str, body: dict[str, Any]) -> None:
    refused_or_answered(lambda: caller.call(name, **body))


@settings(max_examples=60)
@given(
    body=st.binary(max_size=40) | st.just(b"[" * 5000) | st.just(b'{"locator":"\\ud800","user_metadata":{}}')
)
def test_request_of_any_bytes_has_no_internal_error(caller: Client, body: bytes) -> None:
    for name in ("sequence_create", "query", "topic_create"):
        refused_or_answered(lambda name=name: list(caller.flight.do_action(fl.Action(name, body))))
    refused_or_answered(lambda: caller.flight.get_flight_info(fl.FlightDescriptor.for_command(body)))
    refused_or_answered(lambda: caller.flight.do_get(fl.Ticket(body)).read_all())


@settings(max_examples=150)
@given(
    path=st.sampled_from(["value", "source", "timestamp_ns", "value.x", "", "gone"]),
    operator=OPERATORS,
    operand=ANYTHING | st.lists(st.integers() | st.floats(), min_size=2, max_size=2),
)
def test_query_with_any_condition_has_no_internal_error(
    caller: Client, path: str, operator: str, operand: Any
) -> None:
    refused_or_answered(lambda: caller.call("query", ontology={f"Sample.{path}": {operator: operand}}))
    refused_or_answered(lambda: caller.call("query", topic={"name": {operator: operand}}))


@settings(max_examples=60)
@given(start=st.none() | st.integers(), end=st.none() | st.integers())
def test_do_get_with_any_time_range_returns_its_rows_or_is_refused(
    caller: Client, start: int | None, end: int | None
) -> None:
    bounds = {"timestamp_ns_start": start, "timestamp_ns_end": end}
    asked = {name: bound for name, bound in bounds.items() if bound is not None}

    def read() -> None:
        assert caller.rows("drive/imu", **asked) == [
            time for time in (1, 2, 3) if (start is None or start <= time) and (end is None or time < end)
        ]

    refused_or_answered(read)
    assert json.dumps(asked)
