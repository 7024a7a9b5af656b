"""Speculation on element sizes: correct guesses save steps, wrong guesses do not change results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mosaico_ingest.decode import locate as lockstep
from mosaico_ingest.decode.decoder import Decoded
from mosaico_ingest.decode.layout import Payloads, compile_layout
from mosaico_ingest.decode.locate import locate_lockstep
from mosaico_ingest.rosbag.blocks import Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.model import (
    Container,
    Definition,
    Field,
    MessageType,
    Source,
)
from mosaico_ingest.rosbag.serialization import Serializer

BatchOf = Callable[[Sequence[bytes]], MessageBlock]
AssertAgree = Callable[[Sequence[bytes], Definition, Encoding], Decoded]


def _message(name: str, *fields: Field) -> tuple[str, MessageType]:
    return name, MessageType(name, fields)


ROUTES = Definition(
    "test/msg/Routes",
    dict(
        [
            _message(
                "test/msg/Routes",
                Field("stamp", "uint8"),
                Field("stops", "test/msg/Stop", is_message=True, container=Container.SEQUENCE),
            ),
            _message(
                "test/msg/Stop",
                Field("name", "string"),
                Field("x", "float64"),
                Field("tags", "test/msg/Tag", is_message=True, container=Container.SEQUENCE),
                Field("kind", "uint8"),
            ),
            _message("test/msg/Tag", Field("key", "string"), Field("value", "int16")),
        ]
    ),
    Source.BAG,
    "",
    2,
)


def stop(name: str, tags: Sequence[str]) -> dict[str, Any]:
    return {"name": name, "x": 0.5, "tags": [{"key": key, "value": 7} for key in tags], "kind": 3}


def payload(stops: Sequence[dict[str, Any]], encoding: Encoding) -> bytes:
    return Serializer(ROUTES, encoding).from_dict({"stamp": 1, "stops": list(stops)})


TEXTS = st.sampled_from(("", "a", "map", "base", "base_link"))
RUNS = st.lists(
    st.tuples(TEXTS, st.lists(TEXTS, max_size=2), st.integers(1, 40)), max_size=4
)  # what follows each other is mostly alike, and then is not
ENCODINGS = st.sampled_from((Encoding.CDR, Encoding.ROS1))


@settings(deadline=None, suppress_health_check=list(HealthCheck), max_examples=150)
@given(
    messages=st.lists(RUNS, min_size=1, max_size=5),
    copies=st.integers(1, 6),
    encoding=ENCODINGS,
    data=st.data(),
)
def test_speculation_equal_elements_then_others_agree_with_rowwise(
    assert_agree: AssertAgree,
    messages: list[list[tuple[str, list[str], int]]],
    copies: int,
    encoding: Encoding,
    data: st.DataObject,
) -> None:
    whole = [
        payload([stop(name, tags) for name, tags, count in runs for _ in range(count)], encoding)
        for runs in messages
    ]
    broken: list[bytes] = []
    for one in whole:
        at = data.draw(st.integers(0, len(one) - 1))
        broken += [one[:at], one[:at] + bytes([data.draw(st.integers(0, 255))]) + one[at + 1 :]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lockstep, "FEW", data.draw(st.integers(0, 3)))
        patch.setattr(lockstep, "_MANY_ELEMENTS", 0)
        assert not assert_agree(whole * copies, ROUTES, encoding).failures
        assert_agree((whole + broken) * copies, ROUTES, encoding)


@pytest.mark.parametrize("messages", [1, 40])
@pytest.mark.parametrize("encoding", [Encoding.CDR, Encoding.ROS1])
def test_speculation_long_equal_sequences_take_few_steps(
    monkeypatch: pytest.MonkeyPatch, batch_of: BatchOf, messages: int, encoding: Encoding
) -> None:
    steps: list[int] = []
    walk = lockstep._LockstepWalk.body
    monkeypatch.setattr(lockstep._LockstepWalk, "body", lambda *given: steps.append(1) or walk(*given))
    payloads = [payload([stop("map", [])] * (500 + number), encoding) for number in range(messages)]
    batch = batch_of(payloads)
    skip = 4 if encoding is Encoding.CDR else 0
    payloads = Payloads(batch.data, "<", batch.starts + skip, batch.starts + batch.lengths)
    located = locate_lockstep(compile_layout(ROUTES, encoding), payloads)
    assert located.offsets[1].counts.tolist() == [500 + number for number in range(messages)]
    assert len(steps) < 30
