"""Contracts drafted from recordings: the recordings fulfill them, and the limits are the documented ones."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from defective_recordings import DEFECTS, clean_drive, write_drive
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import define
from msgspec.structs import replace

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.report.parts import ContractResult
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.services.draft_contract import (
    FieldKind,
    FieldMeter,
    MeasuredField,
    MeasuredRecording,
    MeasuredTopic,
    _rounded,
    draft_contract,
    measure_recording,
)

LONGEST = 20


def results_of(recording: Path, draft: str, folder: Path) -> ContractResult:
    """Ingest a recording with a drafted contract that does not stop the run, and return the results."""
    folder.mkdir(exist_ok=True)
    (folder / "expect.yaml").write_text(draft)
    manifest = folder / "job.yaml"
    manifest.write_text(
        f"extends: expect.yaml\nbag: {{path: {recording}}}\nsequence: {{name: drafted}}\n"
        "expect: {on_failure: warn}\ntarget: {store: store}\non_error: {topic: ignore, message: ignore}\n"
    )
    findings = lint_paths([manifest], env={}).findings
    assert [str(finding) for finding in findings if finding.severity is Severity.ERROR] == []
    [report] = api.run(api.compile_job(manifest)).recordings
    assert report.contract is not None, report.error
    return report.contract


def failures(result: ContractResult) -> list[str]:
    return [one.line for one in result.results if not one.passed]


@pytest.mark.parametrize("tolerance", [0.0, 20.0])
def test_draft_of_generated_recordings_is_fulfilled_by_all_of_them(tmp_path: Path, tolerance: float) -> None:
    names = {
        "gap",
        "drifting clock",
        "slow stretch",
        "rate too high",
        "out-of-order log times",
        "frame change",
    }
    drives = [clean_drive(), *(one.change(clean_drive()) for one in DEFECTS if one.name in names)]
    paths = [write_drive(drive, tmp_path / str(number)) for number, drive in enumerate(drives)]
    draft = draft_contract([measure_recording(path) for path in paths], tolerance=tolerance)
    for number, path in enumerate(paths):
        assert failures(results_of(path, draft, tmp_path / str(number))) == []


@pytest.mark.parametrize(
    "name",
    [
        "gap",
        "frame change",
        "rate too high",
        "latency burst",
        "wrong type",
        "missing chunk CRC",
        "NaN burst",
    ],
)
def test_draft_of_clean_recording_is_violated_by_defect(tmp_path: Path, name: str) -> None:
    clean = write_drive(clean_drive(), tmp_path / "clean")
    draft = draft_contract([measure_recording(clean)])
    [defect] = [one for one in DEFECTS if one.name == name]
    recording = write_drive(defect.change(clean_drive()), tmp_path / "defective")
    assert failures(results_of(recording, draft, tmp_path / "defective")) != []


def measured(rate: float, gap: int, *, count: int = 100) -> MeasuredRecording:
    topic = MeasuredTopic(
        msgtype="p/msg/A",
        count=count,
        rate_hz=rate,
        gap_ns=gap,
        latency_ns=(-2_000_000, 5_000_000),
        frames=frozenset({"a"}),
        stamps=frozenset({"monotonic"}),
        fulfilled=frozenset({"out_of_order"}),
    )
    return MeasuredRecording({"/a": topic}, 10_000_000_000, frozenset({"unreadable"}))


def test_draft_limits_are_ranges_widened_by_tolerance() -> None:
    text = draft_contract([measured(100, 12_000_000), measured(101, 15_000_000)], tolerance=10)
    assert yaml.safe_load(text)["expect"] == {
        "recording": {"duration": {"min": "9 s", "max": "11 s"}, "unreadable": 0},
        "required": ["/a"],
        "topics": {
            "/a": {
                "type": "p/msg/A",
                "rate": {"min": "90 Hz", "max": "112 Hz"},
                "gap": {"max": "16.5 ms"},
                "latency": {"min": "-2.2 ms", "max": "5.5 ms"},
                "stamps": "monotonic",
                "frame_id": ["a"],
                "out_of_order": 0,
            }
        },
    }


def test_draft_of_irregular_topic_limits_messages_instead_of_rate() -> None:
    draft = yaml.safe_load(draft_contract([measured(1, 60_000_000_000, count=50)]))
    topic = draft["expect"]["topics"]["/a"]
    assert topic["messages"] == {"min": 40}
    assert not {"rate", "gap"} & topic.keys()


def fields_of(*measured_fields: dict[str, MeasuredField], tolerance: float = 50) -> Any:
    recordings = [measured(10, 10**8) for _ in measured_fields]
    drafted = [
        replace(one, topics={"/a": replace(one.topics["/a"], fields=of_recording)})
        for one, of_recording in zip(recordings, measured_fields, strict=True)
    ]
    topics = yaml.safe_load(draft_contract(drafted, tolerance=tolerance))["expect"]["topics"]
    return topics["/a"].get("fields")


def test_draft_limits_stable_numbers_and_expects_finite_others() -> None:
    stable = MeasuredField(limits=(20.0, 21.0), is_stable=True)
    assert fields_of({"a": stable}, {"a": replace(stable, limits=(19.0, 20.0))}) == {
        "a": {"between": [9.5, 31.5]}
    }
    assert fields_of({"a": stable}, {"a": replace(stable, is_stable=False)}) == {"a": {"finite": True}}
    assert fields_of({"a": stable}, {"a": replace(stable, limits=None)}) is None
    assert fields_of({"a": stable}, {}) is None
    assert fields_of({"a": replace(stable, limits=(0.0, 0.0))}) is None


def test_draft_limits_norms_of_vectors_and_unit_quaternions() -> None:
    vector = MeasuredField(FieldKind.VECTOR, (0.1, 2.0), is_stable=True)
    rotation = MeasuredField(FieldKind.QUATERNION, (0.999, 1.0), is_stable=False)
    unset = replace(rotation, limits=(0.0, 1.0))
    assert fields_of({"norm(v)": vector, "norm(q)": rotation, "norm(p)": unset}) == {
        "norm(v)": {"max": 3},
        "norm(q)": {"between": [0.99, 1.01]},
    }


def test_draft_expects_constants_that_all_recordings_share() -> None:
    text, number = MeasuredField(constant="rgb8"), MeasuredField(constant=640, nulls=0)
    assert fields_of({"a": text, "b": number, "c": text}, {"a": text, "b": number, "c": number}) == {
        "a": {"equals": "rgb8"},
        "b": {"equals": 640, "nulls": 0},
    }


@given(st.lists(st.floats(-9, 9) | st.sampled_from([math.nan, math.inf]), min_size=1, max_size=12), st.data())
def test_meter_of_batches_equals_plain_computation(values: list[float], data: st.DataObject) -> None:
    meter = FieldMeter("/a", define("p/msg/A", "float64 x\nint32 n\n"), middle_ns=6)
    times = np.arange(len(values), dtype=np.int64)
    column = np.array(values)
    numbers = np.array(
        data.draw(st.lists(st.integers(0, 1), min_size=len(values), max_size=len(values))), np.int32
    )
    cuts = sorted({0, *data.draw(st.lists(st.integers(0, len(values)), max_size=3)), len(values)})
    for start, end in pairwise(cuts):
        rows = pa.StructArray.from_arrays(
            [pa.array(column[start:end]), pa.array(numbers[start:end])], ["x", "n"]
        )
        meter.add(rows, times[start:end])
    measured_field = meter.finish()["x"]
    is_finite = bool(np.isfinite(column).all())
    assert measured_field.limits == ((column.min(), column.max()) if is_finite else None)
    halves = [half for half in (column[:6], column[6:]) if len(half)]
    is_stable = (
        is_finite
        and len(halves) == 2
        and all(
            abs(limit(halves[0]) - limit(halves[1])) <= 0.25 * (column.max() - column.min())
            for limit in (np.min, np.max)
        )
    )
    assert measured_field.is_stable == is_stable
    assert meter.finish()["n"].constant == (1 if set(numbers.tolist()) == {1} else None)


def test_meter_measures_norms_instead_of_their_members_and_no_times() -> None:
    text = (
        f"p/Vector position\np/Vector speed\np/Rotation q\np/Time t\nfloat32[3] list\nfloat32 volts\n{'=' * 80}\n"
        f"MSG: p/Vector\nfloat64 x\nfloat64 y\n{'=' * 80}\nMSG: p/Rotation\nfloat64 x\nfloat64 y\nfloat64 z\n"
        f"float64 w\n{'=' * 80}\nMSG: p/Time\nint32 sec\nuint32 nanosec\n"
    )
    definition = define("p/msg/A", text)
    meter = FieldMeter("/a", definition, middle_ns=1)
    vector, time = {"x": 3.0, "y": 4.0}, {"sec": 1, "nanosec": 1}
    row = {"position": vector, "speed": vector, "q": {**vector, "z": 0.0, "w": 0.0}, "t": time}
    rows = pa.array([{**row, "list": [1, 2, 3], "volts": 12.0}] * 2, ros_shape(definition))
    meter.add(rows, np.arange(2))
    assert {name: (one.kind, one.limits, one.is_stable) for name, one in meter.finish().items()} == {
        "norm(position)": (FieldKind.VECTOR, (5, 5), False),
        "norm(speed)": (FieldKind.VECTOR, (5, 5), True),
        "norm(q)": (FieldKind.QUATERNION, (5, 5), True),
        "volts": (FieldKind.FIELD, (12, 12), True),
    }


def test_draft_topic_of_some_recordings_is_not_required() -> None:
    other = MeasuredRecording({}, 10_000_000_000, frozenset())
    assert "required" not in yaml.safe_load(draft_contract([measured(10, 10**8), other]))["expect"]


@given(st.floats(1e-6, 1e12), st.booleans())
def test_rounded_moves_outward_by_less_than_a_hundredth(
    value: float,
    up: bool,  # noqa: FBT001 - a drawn value
) -> None:
    written = Decimal(_rounded(value, up=up))
    assert written >= Decimal(value) if up else written <= Decimal(value)
    assert abs(written - Decimal(value)) <= Decimal(value) / 100


def test_init_expect_writes_file_and_refuses_to_replace_it(tmp_path: Path) -> None:
    paths = [str(write_drive(clean_drive(), tmp_path / name)) for name in ("a", "b")]
    out = tmp_path / "expect.yaml"
    words = ["init", "--expect", *paths, "--out", str(out), "--tolerance", "5"]
    for code in (0, 2):
        with pytest.raises(SystemExit) as leave:
            main(words)
        assert (leave.value.code or 0) == code
    assert set(yaml.safe_load(out.read_text())["expect"]["topics"]) == {"/temperature", "/ambient"}


def test_init_of_several_recordings_needs_expect(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as leave:
        main(["init", str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")])
    assert leave.value.code == 2


def longest_recordings(corpus: Path) -> Sequence[str]:
    """Return the paths of the recordings of the index, the longest first."""
    with (corpus / "INDEX.tsv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file, delimiter="\t") if row["duration_s"]]
    return [row["path"] for row in sorted(rows, key=lambda row: -float(row["duration_s"]))]


@pytest.mark.slow
def test_draft_of_each_of_the_longest_real_recordings_is_fulfilled_by_it(
    corpus: Path, tmp_path: Path
) -> None:
    passed = 0
    for position, name in enumerate(longest_recordings(corpus)):
        try:
            recording = measure_recording(corpus / name)
        except (BagError, NothingMatched):  # the corpus has recordings that nothing can read
            continue
        draft = draft_contract([recording])
        assert failures(results_of(corpus / name, draft, tmp_path / str(position))) == [], name
        passed += 1
        if passed == LONGEST:
            return
    pytest.fail(f"only {passed} recordings can be read")
