"""Contracts of recordings with pauses of the recorder, single messages, zero stamps, unsorted files and empty topics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from made_recordings import define, record

from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.contract_check import check_contract
from mosaico_ingest.report.parts import ExpectationResult

SECOND = 10**9
START = 1_700_000_000 * SECOND
TICK = define("std_msgs/msg/Int64", "int64 data\n")
HEADER = (
    f"std_msgs/Header header\n{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
STAMPED = define("acme_msgs/msg/Stamped", HEADER)
EVENTS = "rosbag2_dynamic_recorder_interfaces/msg"
STAMP = f"builtin_interfaces/Time stamp\n{{}}{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
PAUSE = define(f"{EVENTS}/PauseEvent", STAMP.format("uint8 action\n"))
CHANGE = define(
    f"{EVENTS}/SubscriptionChangeEvent", STAMP.format("string topic\nstring topic_type\nuint8 action\n")
)
ZERO = {"sec": 0, "nanosec": 0}


def ticks(*seconds: float) -> list[Any]:
    return [("/tick", TICK, START + int(second * SECOND), {"data": 1}) for second in seconds]


def pause(second: float, action: int) -> Any:
    return ("/events/pause", PAUSE, START + int(second * SECOND), {"stamp": ZERO, "action": action})


def results(path: Path, topics: dict[str, Any], **expect: Any) -> dict[str, ExpectationResult]:
    document = {"expect": {"topics": topics, **expect}}
    job = ROSInjectionConfig(file_path=path, sequence_name="x", manifest=document).job
    return {one.key: one for one in check_contract(job).results}


def test_gap_covered_by_pause_is_explained(tmp_path: Path) -> None:
    messages = [*ticks(0, 1, 2), pause(2.1, 0), pause(8.9, 1), *ticks(9, 10)]
    topic = {"gap": {"max": "1s"}, "rate": {"min": "0.9 Hz"}, "coverage": {"min": "99%", "gap": "1s"}}
    found = results(record(tmp_path / "a.mcap", messages), {"/tick": topic})
    assert {key: (one.outcome.value, one.explained) for key, one in found.items()} == {
        "gap": ("passed", 1),
        "rate": ("passed", 1),
        "coverage": ("passed", 1),
    }


def test_gap_longer_than_pause_is_not_explained(tmp_path: Path) -> None:
    messages = [*ticks(0, 1, 2), pause(5, 0), pause(8.9, 1), *ticks(9, 10)]
    found = results(record(tmp_path / "a.mcap", messages), {"/tick": {"gap": {"max": "1s"}}})
    gap = found["gap"]
    assert (gap.outcome.value, gap.measured, gap.explained) == ("failed", 7 * SECOND, 0)
    assert gap.worst is not None
    assert (gap.worst.index, gap.worst.log_time_ns) == (3, START + 9 * SECOND)


@pytest.mark.parametrize(("topic", "outcome"), [("/tick", "passed"), ("/other", "failed")])
def test_gap_while_topic_is_unsubscribed_is_explained_for_that_topic(
    tmp_path: Path, topic: str, outcome: str
) -> None:
    change = {"stamp": ZERO, "topic": topic, "topic_type": "x"}
    messages = [
        *ticks(0, 1),
        ("/events/change", CHANGE, START + SECOND, {**change, "action": 1}),
        ("/events/change", CHANGE, START + 9 * SECOND, {**change, "action": 0}),
        *ticks(9, 10),
    ]
    found = results(record(tmp_path / "a.mcap", messages), {"/tick": {"gap": {"max": "2s"}}})
    assert found["gap"].outcome.value == outcome


def test_single_message_has_no_gap_and_fails_a_minimum_rate(tmp_path: Path) -> None:
    topic = {
        "rate": {"min": "1 Hz"},
        "gap": {"max": "1s"},
        "gaps": {"over": "2 periods", "max_share": "0%"},
        "sliding_rate": {"window": "1s", "max": "9 Hz"},
    }
    found = results(record(tmp_path / "a.mcap", ticks(3)), {"/tick": topic})
    assert {key: one.outcome.value for key, one in found.items()} == {
        "rate": "failed",
        "gap": "skipped",
        "gaps": "skipped",
        "sliding_rate": "skipped",
    }


def test_topic_without_header_skips_expectations_of_headers(tmp_path: Path) -> None:
    topic = {
        "latency": {"max": "1s"},
        "stamps": "monotonic",
        "frame_id": "a",
    }
    found = results(record(tmp_path / "a.mcap", ticks(0, 1)), {"/tick": topic})
    assert {one.outcome.value for one in found.values()} == {"skipped"}


def test_zero_stamps_fail_the_latency_and_say_so(tmp_path: Path) -> None:
    messages = [("/s", STAMPED, START + i, {"header": {"stamp": ZERO, "frame_id": ""}}) for i in range(3)]
    found = results(record(tmp_path / "a.mcap", messages), {"/s": {"latency": {"max": "1s"}}})
    latency = found["latency"]
    assert (latency.outcome.value, latency.measured, latency.violations) == ("failed", None, 3)
    assert "zero" in latency.text


def test_messages_out_of_order_in_the_file_are_counted_and_sorted_for_gaps(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", ticks(0, 2, 1, 3, 2.5))
    found = results(path, {"/tick": {"out_of_order": 0, "gap": {"max": "1s"}}})
    assert (found["out_of_order"].outcome.value, found["out_of_order"].violations) == ("failed", 2)
    assert found["out_of_order"].worst is not None
    assert found["out_of_order"].worst.value == SECOND
    assert found["gap"].outcome.value == "passed"


def test_wrong_type_is_reported_in_place_of_its_unknown_fields(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", ticks(0, 1))
    topic = {"type": "std_msgs/msg/Float64", "fields": {"value": {"max": 1}}}
    found = results(path, {"/tick": topic})
    assert {key: one.outcome.value for key, one in found.items()} == {
        "type": "failed",
        "fields.value.max": "skipped",
    }


def test_one_of_two_types_on_a_topic_violates_the_type(tmp_path: Path) -> None:
    messages = [*ticks(0, 2), ("/tick", STAMPED, START + SECOND, {"header": {"stamp": ZERO, "frame_id": ""}})]
    path = record(tmp_path / "a.mcap", messages)
    found = results(
        path, {"/tick": {"type": "std_msgs/msg/Int64", "gap": {"max": "1s"}, "messages": {"min": 3}}}
    )
    assert {key: one.outcome.value for key, one in found.items()} == {
        "type": "failed",
        "gap": "passed",
        "messages": "passed",
    }
