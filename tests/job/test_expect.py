"""The section `expect`: its notations, its precedence, and its composition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.job.expect import Expectations
from mosaico_ingest.job.manifest import load_manifest
from mosaico_ingest.job.values import (
    Interval,
    Limit,
    OnFailure,
    format_duration,
    parse_duration,
    parse_interval,
    parse_rate,
    parse_share,
)

ISSUE = """\
bag: {path: drive.mcap}
expect:
  recording: {duration: {min: 30s, max: 2h}, start: {after: 2026-01-01}, unreadable: 0}
  required: [/imu, /gps/fix, "/camera/*/image_raw", {topic: /map, severity: warning}]
  forbidden: ["/debug/*"]
  topics:
    /imu:
      type: sensor_msgs/msg/Imu
      rate: {min: 95 Hz, max: 105 Hz, severity: warning}
      gap: {max: 50 ms}
      messages: {min: 1000}
      rejected: {max: 0.1%}
      latency: {min: -5 ms, max: 200 ms}
      stamps: monotonic
      frame_id: [imu_link]
      gaps: {over: 2 periods, max_share: 5%}
      fields:
        linear_acceleration.z: {between: [-40, 40], finite: true, nulls: 0}
  on_failure: divert
"""


def expectations(tmp_path: Path, text: str) -> Expectations:
    path = tmp_path / "job.yaml"
    path.write_text(text)
    expect = load_manifest(path).manifest.expect
    assert expect is not None
    return expect


def test_expect_every_notation_is_parsed(tmp_path: Path) -> None:
    expect = expectations(tmp_path, ISSUE)
    imu = expect.topics["/imu"]
    assert expect.on_failure is OnFailure.DIVERT
    assert expect.recording.duration is not None
    assert (expect.recording.duration.min, expect.recording.duration.max) == (30 * 10**9, 7200 * 10**9)
    assert expect.recording.start is not None
    assert expect.recording.start.after == 1_767_225_600_000_000_000
    assert expect.recording.unreadable == Limit(count=0)
    assert imu.rate is not None
    assert (imu.rate.min, imu.rate.max, imu.rate.severity) == (95.0, 105.0, "warning")
    assert imu.latency is not None
    assert (imu.latency.min, imu.latency.max) == (-5_000_000, 200_000_000)
    assert imu.gaps is not None
    assert (imu.gaps.over, imu.gaps.max_share) == (Interval(periods=2.0), 0.05)
    assert imu.fields["linear_acceleration.z"].between == (-40.0, 40.0)


@pytest.mark.parametrize(
    ("parse", "text", "expected"),
    [
        (parse_duration, "50 ms", 50_000_000),
        (parse_duration, "1.5h", 5_400_000_000_000),
        (parse_duration, "2 d", 172_800_000_000_000),
        (parse_rate, "2 kHz", 2000.0),
        (parse_rate, "30/min", 0.5),
        (parse_share, "5%", 0.05),
        (parse_interval, "1 period", Interval(periods=1.0)),
        (parse_interval, "100ms", Interval(ns=100_000_000)),
    ],
)
def test_units_valid_text_is_converted(parse: Any, text: str, expected: object) -> None:
    assert parse(text) == expected


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_duration, "-5 ms"),
        (parse_duration, "5"),
        (parse_duration, "9999999h"),
        (parse_rate, "5"),
        (parse_rate, "5 hz"),
        (parse_share, "101%"),
        (parse_share, "5"),
        (parse_interval, "2"),
    ],
)
def test_units_invalid_text_raises_value_error(parse: Any, text: str) -> None:
    with pytest.raises(ValueError, match="write"):
        parse(text)


@pytest.mark.parametrize("ns", [0, 1, 1_500, 50_000_000, 3_600_000_000_000])
def test_format_duration_parses_to_same_value(ns: int) -> None:
    assert parse_duration(format_duration(ns)) == ns


def test_entry_of_prefers_exact_name_then_first_glob_that_defines_the_expectation() -> None:
    expect = Expectations.model_validate(
        {
            "topics": {
                "/*": {"gap": {"max": "1s"}, "rate": {"min": "1 Hz"}},
                "/cam*": {"messages": {"min": 1}},
                "/imu": {"rate": {"min": "90 Hz"}, "fields": {"x": {"finite": True}}},
            }
        }
    )
    assert expect.entry_of("/imu", "rate") == "/imu"
    assert expect.entry_of("/imu", "gap") == "/*"
    assert expect.entry_of("/cam0", "messages") == "/cam*"
    assert expect.entry_of("/imu", "messages") is None
    assert expect.fields_of("/imu") == {"x": "/imu"}
    assert expect.fields_of("/gps") == {}


def test_extends_expectations_are_merged_key_by_key_with_locations(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(
        "expect:\n  topics:\n    /imu: {gap: {max: 50 ms}, rate: {min: 95 Hz, max: 105 Hz}}\n"
    )
    (tmp_path / "job.yaml").write_text(
        "extends: fleet.yaml\nbag: {path: a.mcap}\nexpect:\n  topics:\n    /imu: {rate: {min: 190 Hz}, gap: null}\n"
    )
    loaded = load_manifest(tmp_path / "job.yaml")
    assert loaded.manifest.expect is not None
    imu = loaded.manifest.expect.topics["/imu"]
    assert imu.gap is None
    assert imu.rate is not None
    assert (imu.rate.min, imu.rate.max) == (190.0, 105.0)
    assert loaded.where("expect", "topics", "/imu", "rate", "max").endswith("fleet.yaml:3:55")


@pytest.mark.parametrize(
    ("text", "rule", "column"),
    [
        ("{rate: {min: 95}}", "wrong-type", 26),
        ("{rate: {mn: 95 Hz}}", "unknown-key", 21),
        ("{stamps: monotone}", "wrong-value", 22),
        ("{frame_id: {one_off: [a]}}", "unknown-key", 25),
        ("{fields: {x: {between: [1]}}}", "wrong-value", 36),
    ],
)
def test_expect_mistake_is_reported_at_its_location(
    tmp_path: Path, text: str, rule: str, column: int
) -> None:
    path = tmp_path / "job.yaml"
    path.write_text(f"bag: {{path: a.mcap}}\nexpect:\n  topics:\n    '/imu': {text}\n")
    with pytest.raises(ManifestError) as error:
        load_manifest(path)
    assert (rule, 4, column) in [
        (finding.rule, finding.span.line, finding.span.column)
        for finding in error.value.findings
        if finding.span
    ]


def test_config_expect_is_validated_as_section() -> None:
    config = ROSInjectionConfig(
        file_path="a.mcap",
        sequence_name="a",
        manifest={"expect": {"topics": {"/imu": {"gap": {"max": "50 ms"}}}}},
    )
    assert config.job.expect is not None
    assert config.job.expect.entry_of("/imu", "gap") == "/imu"
