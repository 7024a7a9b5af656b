"""`Stream`: it writes the same rows for all batch sizes, and accounts for every message."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.adapters.adapter import Adapted, Envelope
from mosaico_ingest.errors import AdapterError, DecodeError, SinkError
from mosaico_ingest.findings import RowFailure
from mosaico_ingest.job.values import LoaderErrorPolicy, TopicLevelErrorPolicy
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.pipeline.plan import TopicPlan
from mosaico_ingest.pipeline.topic import TopicPipeline
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.events import Expected, RunStarted
from mosaico_ingest.report.recording import Collector
from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.serialization import Serializer

DEFINITION = TypeResolver("ros2_humble").resolve("std_msgs/msg/Float64", None, ros_version=2)
CONNECTION = Connection(0, "/speed", "std_msgs/msg/Float64", Encoding.CDR, None, DEFINITION)
SPEED = OntologyType("Speed", pa.struct([pa.field("data", pa.float64(), nullable=False)]))
SERIALIZER = Serializer(DEFINITION, Encoding.CDR)
CUT = b"\x00\x01\x00\x00\x01"
"""A payload that ends inside its number."""


class Positive:
    """An adapter that rejects negative numbers."""

    name = "Positive"
    ros_types = ("std_msgs/msg/Float64",)
    default = True
    ontology = SPEED

    def bind(self, _definition: object, _shape: object) -> Positive:
        return self

    def topic_metadata(self, _row: object) -> dict[str, Any]:
        return {}

    def adapt(self, rows: pa.StructArray, envelope: Envelope) -> Adapted:
        values = rows.field(0).to_numpy(zero_copy_only=False)
        good = np.flatnonzero(values >= 0)
        failures = tuple(
            RowFailure(int(row), "negative", f"{values[row]} < 0 in message {envelope.indices[row]}")
            for row in np.flatnonzero(values < 0)
        )
        return Adapted(pa.array([{"data": value} for value in values[good]], SPEED.struct), good, failures)


@dataclass
class Session:
    refuse: bool = False
    batches: list[pa.RecordBatch] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def topic(self, name: str, _ontology: OntologyType, _metadata: object) -> Session:
        if self.refuse:
            raise SinkError("the name is refused", where=name)
        return self

    def write(self, batch: pa.RecordBatch) -> None:
        self.batches.append(batch)

    def note_error(self, message: str, *, topic: str | None = None) -> None:
        self.notes.append(f"{topic}: {message}")

    @property
    def values(self) -> list[float]:
        return [value for batch in self.batches for value in batch.column(1).to_pylist()]


def raw(payloads: list[bytes], first_ns: int) -> MessageBlock:
    lengths = np.array([len(payload) for payload in payloads], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    times = first_ns + np.arange(len(payloads), dtype=np.int64)
    return MessageBlock(
        CONNECTION.id, times, np.frombuffer(b"".join(payloads), np.uint8), starts, lengths, times * 10
    )


def payload(value: float | None) -> bytes:
    return CUT if value is None else SERIALIZER.from_dict({"data": value})


def run(
    values: list[float | None],
    *,
    size: int = 100,
    topic: TopicLevelErrorPolicy = TopicLevelErrorPolicy.Ignore,
    message: LoaderErrorPolicy = LoaderErrorPolicy.IGNORE,
    every: int = 1,
    refuse: bool = False,
) -> tuple[Session, Collector, Exception | None]:
    """Feed messages in batches of `size`; None stands for a payload that cannot be decoded."""
    collector, session = Collector(), Session(refuse=refuse)
    expected = Expected("/speed", "/speed", CONNECTION.msgtype, "Positive", "Speed", "", None)
    collector(RunStarted("s", "d", (), 0, (expected,)))
    plan = TopicPlan(
        topic="/speed",
        target="/speed",
        msgtype=CONNECTION.msgtype,
        connections=(0,),
        adapter=Positive(),
        why="",
        ontology=SPEED,
        count=None,
        metadata={},
        on_error=topic,
        every=every,
    )
    pipeline = TopicPipeline(plan, message, session, collector)
    pipeline.bind(CONNECTION)
    error = None
    try:
        with WriteBuffer(max_bytes=1 << 20) as buffer:
            for start in range(0, len(values), size):
                pipeline.process(raw([payload(v) for v in values[start : start + size]], start), buffer)
    except (AdapterError, DecodeError, SinkError) as raised:
        error = raised
    return session, collector, error


def counts(collector: Collector) -> tuple[int, int, int, int]:
    topic = collector.report().topics[0]
    assert topic.read == topic.written + topic.filtered + topic.downsampled + topic.rejected
    return topic.read, topic.written, topic.downsampled, topic.rejected


MESSAGES = st.lists(st.sampled_from([1.0, 2.0, -1.0, None]), max_size=20)


@given(
    MESSAGES,
    st.sampled_from(list(TopicLevelErrorPolicy)),
    st.sampled_from(list(LoaderErrorPolicy)),
    st.integers(1, 3),
)
def test_topic_result_does_not_depend_on_batch_size(
    values: list[float | None], topic: TopicLevelErrorPolicy, message: LoaderErrorPolicy, every: int
) -> None:
    single = run(values, topic=topic, message=message, every=every)
    for size in (1, 3):
        several = run(values, size=size, topic=topic, message=message, every=every)
        assert several[0].values == single[0].values
        assert counts(several[1]) == counts(single[1])
        assert str(several[2]) == str(single[2])


def test_topic_policy_ignore_rejects_only_the_bad_message() -> None:
    session, collector, error = run([1.0, -1.0, 2.0])
    assert error is None
    assert session.values == [1.0, 2.0]
    assert counts(collector) == (3, 2, 0, 1)


def test_topic_policy_finalize_keeps_earlier_rows_and_rejects_later_ones() -> None:
    session, collector, error = run([1.0, -1.0, 2.0, 3.0], topic=TopicLevelErrorPolicy.Finalize)
    assert error is None
    assert session.values == [1.0]
    rules = {r.rule: r.count for r in collector.report().topics[0].rejections}
    assert rules == {"negative": 1, "topic-closed": 2}


def test_topic_policy_raise_keeps_earlier_rows_and_names_the_offset() -> None:
    session, collector, error = run([1.0, -1.0, 2.0], topic=TopicLevelErrorPolicy.Raise)
    assert isinstance(error, AdapterError)
    assert "offset 10" in str(error)
    assert session.values == [1.0]
    assert counts(collector) == (2, 1, 0, 1)
    assert session.notes


def test_topic_undecodable_message_follows_the_message_policy() -> None:
    session, collector, error = run([1.0, None, 2.0], topic=TopicLevelErrorPolicy.Raise)
    assert error is None
    assert session.values == [1.0, 2.0]
    session, collector, error = run([1.0, None, 2.0], message=LoaderErrorPolicy.RAISE)
    assert isinstance(error, DecodeError)
    assert session.values == [1.0]
    assert counts(collector) == (2, 1, 0, 1)


@pytest.mark.parametrize("every", [1, 2, 3])
def test_topic_every_keeps_the_first_message_of_each_group(every: int) -> None:
    values = [float(value) for value in range(10)]
    session, collector, _ = run(values, size=4, every=every)
    assert session.values == values[::every]
    assert counts(collector)[2] == 10 - len(values[::every])


def test_topic_refused_by_destination_follows_topic_policy() -> None:
    session, collector, error = run([1.0, 2.0, 3.0], size=2, refuse=True)
    assert error is None
    assert session.values == []
    assert counts(collector) == (3, 0, 0, 3)
    assert collector.report().topics[0].rejections[0].rule == "topic-refused"
    _, _, error = run([1.0], topic=TopicLevelErrorPolicy.Raise, refuse=True)
    assert isinstance(error, SinkError)
