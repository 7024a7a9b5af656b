"""Stamps, time ranges, rates and latched messages: runs equal a plain computation over the messages of the recording."""

from __future__ import annotations

import itertools
import json
import tempfile
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_recordings import define, record
from mcap.writer import Writer as OfficialWriter
from numpy.typing import NDArray
from stamped_messages import MESSAGES, SECOND, STAMPED, START_NS, Messages, stamped, write_stamped

from mosaico_ingest import api
from mosaico_ingest.adapters.adapter import Envelope
from mosaico_ingest.contracts.rows import Rows, bind_expression
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.plan import TopicPlan
from mosaico_ingest.pipeline.run import Outcome, make_plan, run_recording
from mosaico_ingest.pipeline.selection import ConditionFilter, Conditions, RowSelector, bind_conditions
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.pipeline.topic import LATCHED_KEY
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.mcap.writer import McapWriter
from mosaico_ingest.rosbag.rosbags_library import open_writer
from mosaico_ingest.rosbag.serialization import Serializer

PLAIN = define("std_msgs/msg/Int32", "int32 data")


def run(path: Path, *, time: Mapping[str, object] | None = None, **keys: object) -> tuple[Outcome, Store]:
    """Ingest a recording into a new store next to it, with additional manifest keys."""
    store = Path(tempfile.mkdtemp(dir=path.parent))
    manifest = {
        "version": 1,
        "bag": {"path": path.name, **({"time": time} if time else {})},
        "sequence": {"name": "s"},
        "target": {"store": store.name},
        **keys,
    }
    job = path.parent / "job.yaml"
    job.write_text(json.dumps(manifest))
    return run_recording(Task(api.compile_job(job)[0])), Store.open(store)


def rules(path: Path) -> dict[str, str]:
    """Return rule and message of each finding of the plan of the latest job."""
    plan = make_plan(Task(api.compile_job(path.parent / "job.yaml")[0]))
    return {finding.rule: finding.message for finding in plan.findings}


def rows(store: Store, topic: str, column: str) -> list[tuple[int, int]]:
    """Return time and value of each row, in the order of the store."""
    table = store.scan("s", topic).read_all()
    return list(zip(table["timestamp_ns"].to_pylist(), table[column].to_pylist(), strict=True))


def expected_rows(
    messages: Messages,
    topic: str,
    *,
    stamp: str,
    offset_ns: int,
    rate: float | None,
    every: int,
    start_ns: int | None,
    end_ns: int | None,
) -> tuple[list[tuple[int, int]], dict[str, int], int]:
    """Return the rows of a topic, the dropped messages by rule and the fallbacks, message by message."""
    kept: list[tuple[int, int]] = []
    dropped: dict[str, int] = {}
    fallbacks, origin, last = 0, None, -1
    by_log = stamp == "log" and offset_ns == 0
    own = sorted(
        ((log, stamp_ns, value) for value, (name, log, stamp_ns) in enumerate(messages) if name == topic),
        key=lambda message: message[0],
    )
    number = -1
    for log, stamp_ns, value in own:
        time_ns = START_NS + log
        inside_log = (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns)
        if by_log and not inside_log:
            continue  # the reader skips it
        number += 1
        if number % every:
            dropped["every"] = dropped.get("every", 0) + 1
            continue
        if stamp == "header" and stamp_ns == 0:
            fallbacks += 1
        elif stamp == "header":
            time_ns = stamp_ns
        time_ns += offset_ns
        if not by_log and not (
            (start_ns is None or time_ns >= start_ns) and (end_ns is None or time_ns < end_ns)
        ):
            dropped["time_range"] = dropped.get("time_range", 0) + 1
            continue
        if rate is not None:
            origin = time_ns if origin is None else origin
            interval = int(np.floor_divide(time_ns - origin, SECOND / rate))
            if interval <= last:
                dropped["rate"] = dropped.get("rate", 0) + 1
                continue
            last = interval
        kept.append((time_ns, value))
    return sorted(kept), dropped, fallbacks


@settings(deadline=None, max_examples=60)
@given(
    messages=MESSAGES,
    stamp=st.sampled_from(["log", "header"]),
    offset_ns=st.sampled_from([0, 0, -2 * SECOND, 500_000_000]),
    rate=st.sampled_from([None, 0.5, 1.0, 3.0]),
    every=st.sampled_from([1, 1, 2]),
    window=st.sampled_from([(None, None), (1, 4), (0, 2), (3, None)]),
)
def test_run_with_time_settings_equals_message_by_message_computation(
    *,
    messages: Messages,
    stamp: str,
    offset_ns: int,
    rate: float | None,
    every: int,
    window: tuple[int | None, int | None],
) -> None:
    messages = [*messages, ("/c", 0, 0), ("/c", 5 * SECOND, 0)]  # so that every time range selects a message
    start_ns, end_ns = (None if second is None else START_NS + second * SECOND for second in window)
    with tempfile.TemporaryDirectory() as folder:
        path = write_stamped(Path(folder) / "drive.mcap", messages)
        topic_settings: dict[str, object] = {
            "stamp": stamp,
            "time_offset": f"{offset_ns // 1_000_000:+} ms",
            "every": every,
            **({} if rate is None else {"rate": f"{rate} Hz"}),
        }
        bounds = {
            key: f"{datetime.fromtimestamp(bound // SECOND, tz=timezone.utc):%Y-%m-%dT%H:%M:%SZ}"
            for key, bound in (("start", start_ns), ("end", end_ns))
            if bound is not None
        }
        outcome, store = run(path, time=bounds, topic_settings={"/[ab]": topic_settings})
        for topic in ("/a", "/b"):
            if not any(name == topic for name, _, _ in messages):
                continue
            kept, dropped, fallbacks = expected_rows(
                messages,
                topic,
                stamp=stamp,
                offset_ns=offset_ns,
                rate=rate,
                every=every,
                start_ns=start_ns,
                end_ns=end_ns,
            )
            report = next(one for one in outcome.report.topics if one.target == topic)
            assert dict(report.dropped) == dropped
            assert report.stamp_fallbacks == fallbacks
            assert report.written == len(kept)
            assert report.read == report.written + report.filtered + report.downsampled + report.rejected
            assert (sorted(rows(store, topic, "value")) if kept else []) == kept


def select(
    selector: RowSelector, times: NDArray[np.int64], rows: pa.StructArray | None = None
) -> tuple[NDArray[np.bool_] | None, Mapping[str, NDArray[np.bool_]]]:
    """Select rows by their times, and by the conditions of the selector's plan if there are rows."""
    conditions = None if rows is None else bind_conditions(selector.plan, STAMPED)
    rows = pa.array([{}] * len(times), pa.struct([])) if rows is None else rows
    return selector.select(times, rows, Envelope("/a", "", times), conditions)


@given(
    times=st.lists(st.integers(0, 10 * SECOND), max_size=30),
    rate=st.sampled_from([0.3, 1.0, 2.5, 10.0]),
    cuts=st.lists(st.integers(0, 30), max_size=4),
)
def test_rate_result_does_not_depend_on_batch_size(times: list[int], rate: float, cuts: list[int]) -> None:
    plan = TopicPlan.model_construct(rate=rate)
    complete, batched = RowSelector(plan), RowSelector(plan)
    values = np.array(times, np.int64)
    expected, _ = select(complete, values)
    bounds = [0, *sorted(min(cut, len(times)) for cut in cuts), len(times)]
    masks = [
        np.ones(end - start, bool) if mask is None else mask
        for start, end in itertools.pairwise(bounds)
        for mask, _ in [select(batched, values[start:end])]
    ]
    assert np.concatenate(masks).tolist() == ([True] * len(times) if expected is None else expected.tolist())


def test_rate_keeps_first_message_of_each_interval(tmp_path: Path) -> None:
    sent = [("/a", PLAIN, START_NS + i * 30_000_000, {"data": i}) for i in range(100)]
    outcome, store = run(record(tmp_path / "drive.mcap", sent), topic_settings={"/a": {"rate": "10 Hz"}})
    kept = [value for _, value in rows(store, "/a", "data")]
    assert kept == [min(i for i in range(100) if i * 30 // 100 == interval) for interval in range(30)]
    assert outcome.report.topics[0].downsampled == 70


ROWS = st.lists(
    st.tuples(st.integers(-2, 3), st.sampled_from(["a", "b"]), st.integers(0, 5 * SECOND)), max_size=20
)


@given(
    messages=ROWS,
    where=st.sampled_from([None, "value > 0", "value != 1 and header.frame_id == 'a'"]),
    on_change=st.sampled_from([(), ("value",), ("header.frame_id",), ("value", "header.frame_id")]),
    rate=st.sampled_from([None, 1.0]),
    cuts=st.lists(st.integers(0, 20), max_size=3),
)
def test_conditions_equal_message_by_message_evaluation(
    *,
    messages: list[tuple[int, str, int]],
    where: str | None,
    on_change: tuple[str, ...],
    rate: float | None,
    cuts: list[int],
) -> None:
    selector = RowSelector(TopicPlan.model_construct(where=where, on_change=on_change, rate=rate))
    conditions = {
        None: lambda _value, _frame: True,
        "value > 0": lambda value, _frame: value > 0,
        "value != 1 and header.frame_id == 'a'": lambda value, frame: value != 1 and frame == "a",
    }
    fields = {"value": 0, "header.frame_id": 1}
    expected: list[bool] = []
    previous = origin = None
    last = -1
    for message in messages:
        keep = bool(conditions[where](*message[:2]))
        current = [message[fields[name]] for name in on_change]
        if keep and on_change:
            keep, previous = current != previous, current
        if keep and rate is not None:
            origin = message[2] if origin is None else origin
            interval = (message[2] - origin) // SECOND
            keep = interval > last
            last = max(last, interval)
        expected.append(keep)
    times = np.array([time for _, _, time in messages], np.int64)
    columns = pa.array(
        [
            {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame}, "value": value}
            for value, frame, _ in messages
        ],
        ros_shape(STAMPED),
    )
    bounds = [0, *sorted(min(cut, len(messages)) for cut in cuts), len(messages)]
    actual: list[bool] = []
    for start, end in itertools.pairwise(bounds):
        mask, dropped = select(selector, times[start:end], columns[start:end])
        keep_mask = np.ones(end - start, bool) if mask is None else mask
        actual += keep_mask.tolist()
        assert sum(one.sum() for one in dropped.values()) == (~keep_mask).sum()
    assert actual == expected


def test_on_change_compares_nan_and_null_by_identity() -> None:
    shape = pa.struct([("x", pa.float64())])
    column = pa.array([{"x": x} for x in (1.0, float("nan"), float("nan"), None, None, 1.0)], shape)
    expression, _ = bind_expression("x", Rows(shape), None, lambda *_: None)
    assert expression is not None
    conditions = Conditions(None, (expression,))
    expected = [True, True, False, True, False, True]
    for size in (1, 2, 6):
        changes = ConditionFilter()
        actual = [
            kept
            for start in range(0, 6, size)
            for kept in changes.select(
                conditions, column[start : start + size], Envelope("/a", "", np.zeros(size, np.int64))
            )[1].tolist()
        ]
        assert actual == expected


def test_run_with_conditions_counts_what_each_rule_drops(tmp_path: Path) -> None:
    values = [0, 1, 1, 2, 2, 2, 0, 3]
    sent = [("/a", PLAIN, START_NS + i, {"data": value}) for i, value in enumerate(values)]
    outcome, store = run(
        record(tmp_path / "drive.mcap", sent),
        topic_settings={"/a": {"where": "data > 0", "on_change": ["data"]}},
    )
    assert [value for _, value in rows(store, "/a", "data")] == [1, 2, 3]
    report = outcome.report.topics[0]
    assert (report.filtered, dict(report.dropped)) == (5, {"where": 2, "on_change": 3})


@pytest.mark.parametrize(
    ("settings_of_topic", "rule", "column"),
    [
        ({"where": "dta > 0"}, "unknown-field", 1),
        ({"where": "data"}, "operand-type", 1),
        ({"where": "data >"}, "expression-syntax", None),
        ({"on_change": ["header.stmp"]}, "unknown-field", None),
    ],
)
def test_condition_with_mistake_is_located_in_plan_and_run(
    tmp_path: Path, settings_of_topic: dict[str, object], rule: str, column: int | None
) -> None:
    path = record(tmp_path / "drive.mcap", [("/a", PLAIN, START_NS, {"data": 1})])
    outcome, _ = run(path, topic_settings={"/a": settings_of_topic})
    assert outcome.report.exit_code == 2
    with pytest.raises(ManifestError) as raised:
        make_plan(Task(api.compile_job(tmp_path / "job.yaml")[0]))
    finding = raised.value.findings[0]
    assert finding.span is not None
    text = (tmp_path / "job.yaml").read_text()
    place = text[finding.span.column - 1 :]
    assert finding.rule == rule
    assert column is None or place.startswith(str(settings_of_topic["where"])[:3])


def test_stamp_of_type_without_header_falls_back_to_log_time(tmp_path: Path) -> None:
    sent = [("/a", PLAIN, START_NS + i, {"data": i}) for i in range(3)]
    outcome, store = run(record(tmp_path / "drive.mcap", sent), topic_settings={"/a": {"stamp": "header"}})
    assert rows(store, "/a", "data") == [(START_NS + i, i) for i in range(3)]
    assert outcome.report.topics[0].stamp_fallbacks == 3


def test_run_with_all_messages_dropped_exits_with_3(tmp_path: Path) -> None:
    sent = [("/a", STAMPED, START_NS + i, stamped(i, START_NS)) for i in range(3)]
    outcome, _ = run(
        record(tmp_path / "drive.mcap", sent),
        time={"end": "2020-01-01"},
        topic_settings={"/a": {"stamp": "header"}},
    )
    assert outcome.report.exit_code == 3


def latched_recording(path: Path) -> Path:
    """Write a transient-local topic, static transforms, a topic to list, and an ordinary topic."""
    qos = "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    with open_writer(path) as writer:
        assert isinstance(writer, McapWriter)
        channels = {
            "/map": writer.add_connection("/map", PLAIN, metadata={"offered_qos_profiles": qos}),
            "/tf_static": writer.add_connection("/tf_static", PLAIN),
            "/route": writer.add_connection("/route", PLAIN),
            "/imu": writer.add_connection("/imu", PLAIN),
        }
        serializer = Serializer(PLAIN, Encoding.CDR)
        for second in range(6):
            for topic, channel in channels.items():
                if topic == "/imu" or second in {0, 2, 5}:
                    payload = serializer.from_dict({"data": second})
                    writer.write(channel, START_NS + second * SECOND, payload)
    return path


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ({}, {"/map": [2, 5], "/tf_static": [0, 2, 5], "/route": [5], "/imu": [3, 4, 5]}),
        (
            {"latched": ["/rou*"]},
            {"/map": [2, 5], "/tf_static": [0, 2, 5], "/route": [2, 5], "/imu": [3, 4, 5]},
        ),
        (
            {"include_latched": False, "latched": ["/route"]},
            {"/map": [5], "/tf_static": [5], "/route": [5], "/imu": [3, 4, 5]},
        ),
    ],
)
def test_time_range_includes_latched_messages(
    tmp_path: Path, time: dict[str, object], expected: dict[str, list[int]]
) -> None:
    path = latched_recording(tmp_path / "drive.mcap")
    outcome, store = run(path, time={"start": "+3s", **time})
    assert outcome.report.exit_code == 0
    for topic, values in expected.items():
        stored = rows(store, topic, "data")
        assert stored == [(START_NS + second * SECOND, second) for second in values]
        latched = sum(second < 3 for second in values)
        report = next(one for one in outcome.report.topics if one.target == topic)
        assert (report.latched, report.written) == (latched, len(values))
        before = {"before_ns": START_NS + 3 * SECOND} if latched else None
        assert store.topic("s", topic).metadata.get(LATCHED_KEY) == before


def test_plan_reports_latched_topics(tmp_path: Path) -> None:
    path = latched_recording(tmp_path / "drive.mcap")
    run(path, time={"start": "+3s"})
    assert set(rules(path)) == {"latched-topic"}
    run(path, time={"start": "+3s", "include_latched": False})
    assert set(rules(path)) == {"static-topic"}


def test_latched_glob_without_match_is_reported(tmp_path: Path) -> None:
    path = latched_recording(tmp_path / "drive.mcap")
    run(path, time={"start": "+3s", "latched": ["/rout"]})
    assert "'/rout'" in rules(path)["unmatched-pattern"]


def test_latched_messages_keep_settings_of_the_range_unaffected(tmp_path: Path) -> None:
    path = latched_recording(tmp_path / "drive.mcap")
    _, store = run(path, time={"start": "+3s"}, topic_settings={"/*": {"every": 2}})
    assert [value for _, value in rows(store, "/imu", "data")] == [3, 5]
    assert [value for _, value in rows(store, "/map", "data")] == [2, 5]


def published_recording(path: Path) -> Path:
    """Write three messages that were published earlier than they were logged, the last one without publish time."""
    with path.open("wb") as file:
        writer = OfficialWriter(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", PLAIN.text.encode())
        channel = writer.register_channel("/a", "cdr", schema)
        serializer = Serializer(PLAIN, Encoding.CDR)
        for value, published_ns in enumerate((START_NS - 5, START_NS + 5, 0)):
            payload = serializer.from_dict({"data": value})
            writer.add_message(channel, START_NS + 10 * value, payload, published_ns, sequence=7 + value)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ({"where": f"message.log_time >= {START_NS + 10}"}, [1, 2]),
        ({"where": "message.publish_time < message.log_time and message.publish_time > 0"}, [0, 1]),
        ({"where": "message.sequence != 8"}, [0, 2]),
        ({"where": "message.topic == '/a' and data != 1"}, [0, 2]),
        ({"where": "data > 0", "on_change": ["message.sequence"]}, [1, 2]),
        ({"on_change": ["message.topic"]}, [0]),
        ({"where": "100 // data > message.sequence"}, [1, 2]),  # the first message has no value
    ],
)
def test_conditions_use_the_properties_of_messages(
    tmp_path: Path, settings: Mapping[str, object], values: list[int]
) -> None:
    path = published_recording(tmp_path / "drive.mcap")
    _, store = run(path, topic_settings={"/a": settings})
    assert [value for _, value in rows(store, "/a", "data")] == values


def test_stamp_publish_uses_publish_times_of_mcap(tmp_path: Path) -> None:
    path = published_recording(tmp_path / "drive.mcap")
    outcome, store = run(path, topic_settings={"/a": {"stamp": "publish"}})
    assert rows(store, "/a", "data") == [(START_NS - 5, 0), (START_NS + 5, 1), (START_NS + 20, 2)]
    assert outcome.report.topics[0].stamp_fallbacks == 1


@pytest.mark.parametrize("suffix", ["db3", "bag"])
def test_stamp_publish_without_publish_times_is_reported(tmp_path: Path, suffix: str) -> None:
    definition = define("std_msgs/msg/Int32", "int32 data", version=1) if suffix == "bag" else PLAIN
    sent = [("/a", definition, START_NS + i, {"data": i}) for i in range(3)]
    path = record(tmp_path / f"drive.{suffix}", sent)
    _, store = run(path, topic_settings={"/a": {"stamp": "publish"}})
    assert rows(store, "/a", "data") == [(START_NS + i, i) for i in range(3)]
    assert "no-publish-times" in rules(path)


def test_lint_locates_syntax_mistakes_of_conditions(tmp_path: Path) -> None:
    job = tmp_path / "job.yaml"
    job.write_text(
        'version: 1\nbag: {path: "*.mcap"}\ntopic_settings:\n  /a:\n    where: data >\n    on_change: [x, "y +"]\n'
    )
    findings = [
        finding for finding in lint_paths([job], env={}).findings if finding.rule == "expression-syntax"
    ]
    assert [finding.span.line for finding in findings if finding.span] == [5, 6]
