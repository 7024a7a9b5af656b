"""`ingest store head`, `tail`, `sample` and `describe`."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from mosaico_ingest import api
from mosaico_ingest.cli.app import command_line

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
IMU = "quickstart_drive/imu"
START_NS = 1767225600000050000


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("rows") / "store"
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    api.run([job.replace(target=job.target.replace(store=str(folder)))])
    return str(folder)


@pytest.fixture
def output(store: str) -> Callable[..., str]:
    """Return the function that runs a command of `ingest store` and returns its output."""

    def run(*words: str, code: int = 0) -> str:
        result = CliRunner().invoke(command_line(["store"]), ["store", *words, "--store", store])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert result.exit_code == code, result.output
        return result.output

    return run


def test_head_prints_first_rows_with_times_and_selected_columns(output: Callable[..., str]) -> None:
    lines = output("head", IMU, "-n", "2", "-c", "acceleration.z,header.frame_id").splitlines()
    assert [line.split() for line in lines] == [
        ["timestamp_ns", "acceleration.z", "header.frame_id"],
        ["2026-01-01", "00:00:00.000050", "9.81", "imu_link"],
        ["2026-01-01", "00:00:00.010050", "9.81", "imu_link"],
    ]


def test_head_json_has_exact_values(output: Callable[..., str]) -> None:
    (row,) = json.loads(output("head", IMU, "-n", "1", "--json"))
    assert row["timestamp_ns"] == START_NS
    assert row["acceleration"]["y"] == 1.9684381231106272
    (flat,) = json.loads(output("head", IMU, "-n", "1", "--json", "--flatten", "-c", "acceleration"))
    assert flat["acceleration.y"] == 1.9684381231106272
    assert "acceleration" not in flat


def test_head_csv_has_flat_columns_and_times_in_ns(output: Callable[..., str]) -> None:
    rows = list(csv.DictReader(io.StringIO(output("head", IMU, "-n", "3", "--csv"))))
    assert [row["timestamp_ns"] for row in rows] == [str(START_NS + step * 10**7) for step in range(3)]
    assert rows[0]["header.timestamp"] == "1767225600000000000"
    assert rows[0]["acceleration.z"] == "9.81"
    assert rows[0]["header.sample_counter"] == ""


@pytest.mark.parametrize(
    ("words", "steps"),
    [
        (["head", "--at", "+1s", "-n", "2"], [100, 101]),
        (["head", "--at", str(START_NS + 10**9), "-n", "1"], [100]),
        (["head", "--at", "2026-01-01T00:00:01Z", "-n", "1"], [100]),
        (["tail", "-n", "2"], [998, 999]),
        (["tail", "--at", "-1s", "-n", "2"], [898, 899]),
        (["tail", "--at", "+1s", "-n", "1"], [100]),
        (["sample", "-n", "4"], [0, 333, 666, 999]),
        (["sample", "--at", "+1s", "--at", "+0.016s"], [2, 100]),
        (["head", "--at", "+1h"], []),
        (["head", "-n", "0"], []),
    ],
)
def test_rows_are_selected_by_count_and_time(
    output: Callable[..., str], words: list[str], steps: list[int]
) -> None:
    rows = json.loads(output(words[0], IMU, *words[1:], "--json", "-c", "header.frame_id"))
    assert [(row["timestamp_ns"] - START_NS) // 10**7 for row in rows] == steps


def test_head_binary_is_size_and_kind(output: Callable[..., str]) -> None:
    path = "quickstart_drive/camera/image_raw/compressed"
    assert "<6,123 bytes, png>" in output("head", path, "-n", "1")
    assert json.loads(output("head", path, "-n", "1", "--json"))[0]["data"] == "<6,123 bytes, png>"


def test_head_wide_rows_are_printed_as_one_line_per_column(output: Callable[..., str]) -> None:
    lines = output("head", "quickstart_drive/odom", "-n", "1", "--flatten").splitlines()
    assert lines[0] == "timestamp_ns 2026-01-01 00:00:00.000051"
    assert ["velocity.linear.x", "3.14159265"] in [line.split() for line in lines]
    assert "more columns are null in these rows" in lines[-1]


def test_head_without_rows_states_it(output: Callable[..., str]) -> None:
    assert output("head", IMU, "--at", "+1h") == f"{IMU}: no rows here\n"


@pytest.mark.parametrize(
    "words",
    [
        ["head", "quickstart_drive"],
        ["head", IMU, "--at", "noon"],
        ["head", IMU, "--columns", "acc"],
        ["tail", IMU, "-n", "-1"],
    ],
)
def test_rows_wrong_usage_exits_with_2(output: Callable[..., str], words: list[str]) -> None:
    output(*words, code=2)


def test_describe_sequence_prints_rate_and_gaps_of_each_topic(output: Callable[..., str]) -> None:
    lines = [line.split() for line in output("describe", "quickstart_drive").splitlines()]
    assert ["/imu", "IMU", "1,000"] in [line[:3] for line in lines]
    assert next(line for line in lines if line[0] == "/imu")[5:7] == ["100.0", "Hz"]
    values = json.loads(output("describe", "quickstart_drive", "--json"))
    assert {topic["topic"]: topic["rows"] for topic in values["topics"]}["/odom"] == 200


def test_describe_topic_prints_statistics_of_its_columns(output: Callable[..., str]) -> None:
    text = output("describe", IMU)
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line}
    assert rows["acceleration.y"] == ["double", "m/s²", "0", "1.90451578", "2.04636564", "1.97379", "1,000"]
    assert rows["acceleration.covariance"][0] == "double[9]"
    assert "header.sample_counter" not in rows
    assert "header.sample_counter" in output("describe", IMU, "--all")
    columns = json.loads(output("describe", IMU, "--json"))["columns"]
    assert {column["path"]: column["nulls"] for column in columns}["header.sample_counter"] == 1000


def test_describe_topic_lists_its_gaps(output: Callable[..., str], store: str, tmp_path: Path) -> None:
    manifest = tmp_path / "job.yaml"
    drive = JOB.parent / "quickstart" / "drive.mcap"
    manifest.write_text(
        f"bag: {{path: {drive}, time: {{end: +1s}}}}\ntopics: [/imu]\n"
        f"sequence: {{name: torn, if_exists: append}}\ntarget: {{store: {store}}}\n"
    )
    api.run(api.compile_job(manifest))
    manifest.write_text(manifest.read_text().replace("end: +1s", "start: -1s"))
    api.run(api.compile_job(manifest))
    text = output("describe", "torn/imu")
    assert "1 gap:\n  8.00 s from 2026-01-01 00:00:00.990 to 2026-01-01 00:00:08.990" in text
