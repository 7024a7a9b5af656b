"""`ingest plan`, `diff`, `expand` and `init`, and running exactly a plan."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pipeline.plan import digest_of
from mosaico_ingest.pipeline.plan_document import PlanDocument

ROOT = Path(__file__).resolve().parents[2]
JOB = "configs/quickstart.yaml"


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def ingest(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    def call(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as leave:
            main(list(arguments))
        output = capsys.readouterr()
        assert "Traceback" not in output.err
        return int(leave.value.code or 0), output.out + output.err

    return call


def edit(file: str, old: str, new: str) -> None:
    text = Path(file).read_text()
    assert old in text
    Path(file).write_text(text.replace(old, new))


def location(text: str, file: str = JOB) -> str:
    """Return file, line and column of the first occurrence of a text."""
    before, _, _ = Path(file).read_text().partition(text)
    return f"{file}:{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"


Ingest = Callable[..., tuple[int, str]]


def test_plan_prints_topics_with_reasons_and_writes_nothing(ingest: Ingest) -> None:
    code, output = ingest("plan", JOB)
    assert code == 0
    assert "quickstart_drive → mosaico" in output
    assert "configs/quickstart/drive.mcap: mcap, " in output
    battery = next(line for line in output.splitlines() if line.startswith("/battery"))
    assert "BatteryPackAdapter" in battery
    assert "10 accepted" in battery
    excluding = location('"!/camera')
    assert f"{excluding}: info[skipped-topic] /camera/image_raw: " in output
    assert "will be created" in output
    assert not Path("mosaico").exists()


def test_plan_unmatched_patterns_are_reported_with_location(ingest: Ingest) -> None:
    edit(JOB, '["*", "!/camera/image_raw"]', '["*", /imuu]')
    edit(JOB, '"/camera/*": ignore', '"/kamera/*": ignore')
    with Path(JOB).open("a") as file:
        file.write("topic_settings: {/gps/fixx: {every: 2}}\n")
    code, output = ingest("plan", JOB)
    assert code == 0
    assert (
        f"{location('/imuu')}: warning[unmatched-pattern] topics: '/imuu' matches none of 10 topics" in output
    )
    assert "the nearest is /imu" in output
    assert "on_error.topic: '/kamera/*' matches none" in output
    assert "topic_settings: '/gps/fixx' matches none of 10 topics — the nearest is /gps/fix" in output


def test_plan_adapter_override_note_has_location(ingest: Ingest) -> None:
    edit(JOB, "adapters:\n", 'adapters:\n  override: {"/od*": OdometryAdapter}\n')
    with Path(JOB).open("a") as file:
        file.write("quarantine: {max: 1%}\n")
    code, output = ingest("plan", JOB, "--json")
    assert code == 0
    (recording,) = PlanDocument.model_validate_json(output).recordings
    (note,) = (note for note in recording.notes if note.rule == "adapter-override")
    assert note.message == "/odom: OdometryAdapter by '/od*'"
    assert note.location == location('"/od*"')
    quarantine = recording.plan["quarantine"]
    assert (quarantine["path"], quarantine["max"]) == ("quarantine", 0.01)


def test_plan_mismatched_adapters_are_reported_together(ingest: Ingest) -> None:
    edit("configs/quickstart/adapters/battery_pack.yaml", "voltage: voltage_mv", "voltage: gone")
    edit(JOB, "adapters:\n", "adapters:\n  override: {/imu: GPSAdapter}\n")
    code, output = ingest("plan", JOB)
    assert code == 1
    assert "battery_pack.yaml:10:12: error[unknown-field] no field 'gone'" in output
    assert f"{location('/imu: GPS')}: error[type-mismatch]" in output
    assert "GPSAdapter" in output


def test_plan_sample_with_rejections_exits_4(ingest: Ingest) -> None:
    edit("configs/quickstart/adapters/battery_pack.yaml", "map: {0: 3, 1: 1, 2: 2}", "map: {0: 3}")
    code, output = ingest("plan", JOB)
    assert code == 4
    assert "10 of 10 rejected" in output
    assert "/battery: 10 of 10 would be rejected [" in output
    assert not Path("mosaico").exists()


def test_plan_document_fits_schema_and_round_trips(ingest: Ingest) -> None:
    code, output = ingest("plan", JOB, "--json")
    assert code == 0
    schema = json.loads((ROOT / "schemas" / "plan.schema.json").read_text())
    Draft202012Validator(schema).validate(json.loads(output))
    document = PlanDocument.model_validate_json(output)
    assert document.job == JOB
    (recording,) = document.recordings
    assert recording.digest == digest_of(recording.plan)
    assert [topic["topic"] for topic in recording.plan["excluded"]] == ["/camera/image_raw"]
    assert sum(topic["count"] or 0 for topic in recording.plan["topics"]) == 2110
    assert {sample.target: sample.rejected for sample in recording.samples if sample.rejected} == {}
    assert all(sample.row_bytes for sample in recording.samples)
    assert "_ros_" not in output


def test_plan_from_other_folder_is_equal(
    ingest: Ingest, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit(JOB, "target: {store: ../mosaico}", "target: {store: store}")
    ingest("plan", JOB, "--out", "plans/plan.json")
    monkeypatch.chdir(project / "configs")
    assert ingest("plan", "quickstart.yaml", "--check", "../plans/plan.json") == (
        0,
        "the plans are equal\n",
    )


def test_plan_check_changed_manifest_exits_1_with_differences(ingest: Ingest) -> None:
    ingest("plan", JOB, "--out", "plan.json")
    edit(JOB, '"!/camera/image_raw"', '"!/camera/image_raw", "!/odom"')
    edit(JOB, "demo-01", "demo-02")
    edit(JOB, '"/camera/*": ignore', '"/camera/*": finalize')
    code, output = ingest("plan", JOB, "--check", "plan.json")
    assert code == 1
    lines = output.splitlines()
    assert "quickstart_drive: sequence metadata vehicle: demo-01 → demo-02" in lines
    assert "quickstart_drive: - topic /odom: nav_msgs/msg/Odometry by OdometryAdapter to MotionState" in lines
    assert "quickstart_drive: + excluded topic /odom: excluded by '!/odom' in `topics`" in lines
    assert "quickstart_drive: topic /camera/camera_info on_error: ignore → finalize" in lines
    assert len(lines) == 5


def test_plan_check_detects_changed_contract_and_run_refuses_its_plan(ingest: Ingest) -> None:
    with Path(JOB).open("a") as file:
        file.write("\nexpect: {required: [/imu], topics: {/imu: {rate: {min: 50 Hz}}}}\n")
    assert ingest("run", JOB)[0] == 0
    ingest("plan", JOB, "--out", "plan.json")
    edit(JOB, "min: 50 Hz", "min: 60 Hz")
    assert ingest("plan", JOB, "--check", "plan.json") == (
        1,
        "quickstart_drive: contract topics /imu rate min: 50 Hz → 60 Hz\n",
    )
    code, output = ingest("run", "--plan", "plan.json")
    assert code == 1
    assert "[plan-drift]" in output
    edit(JOB, "required: [/imu], ", "")
    assert '- contract required: ["/imu"]' in ingest("plan", JOB, "--check", "plan.json")[1]


def test_plan_check_detects_changed_adapter_but_not_comments(ingest: Ingest) -> None:
    adapter = "configs/quickstart/adapters/battery_pack.yaml"
    ingest("plan", JOB, "--out", "plan.json")
    Path(adapter).write_text("# a remark\n" + Path(adapter).read_text())
    assert ingest("plan", JOB, "--check", "plan.json")[0] == 0
    edit(adapter, "location: header.frame_id", "location: '\"roof\"'")
    code, output = ingest("plan", JOB, "--check", "plan.json")
    assert code == 1
    assert "topic /battery adapter digest" in output


def test_run_plan_runs_only_if_it_still_fits(ingest: Ingest) -> None:
    ingest("plan", JOB, "--out", "plans/plan.json")
    assert ingest("run", "--plan", "plans/plan.json", "-q")[0] == 0
    assert Store.open("mosaico").names() == ("quickstart_drive",)
    shutil.rmtree("mosaico")
    edit(JOB, '"!/camera/image_raw"', '"!/odom"')
    code, output = ingest("run", "--plan", "plans/plan.json", "-q")
    assert code == 1
    assert "- topic /odom" in output
    assert "plan-drift" in output
    assert not Path("mosaico").exists()


def test_plan_existing_sequence_states_action(ingest: Ingest) -> None:
    ingest("run", JOB, "-q")
    code, output = ingest("plan", JOB)
    assert code == 1
    assert "store mosaico refuses: there is a sequence 'quickstart_drive'" in output
    edit(JOB, "sequence:\n", "sequence:\n  if_exists: replace\n")
    code, output = ingest("plan", JOB)
    assert code == 0
    assert "contains quickstart_drive; action: replace" in output


def test_plan_incompatible_append_is_refused(ingest: Ingest) -> None:
    ingest("run", JOB, "-q")
    edit(JOB, "sequence:\n", "sequence:\n  if_exists: append\n")
    assert ingest("plan", JOB)[0] == 0
    with Path(JOB).open("a") as file:
        file.write("topic_settings: {/imu: {rename: /imu2}, /gps/fix: {rename: /imu}}\n")
    code, output = ingest("plan", JOB)
    assert code == 1
    assert "the topic holds IMU" in output


@pytest.mark.slow
def test_plan_contacts_server_only_with_connect(ingest: Ingest) -> None:
    edit(JOB, "target: {store: ../mosaico}", "target: {host: 127.0.0.1, port: 1}")
    code, output = ingest("plan", JOB)
    assert code == 0
    assert "server 127.0.0.1:1: not checked; use --connect to check it" in output
    code, output = ingest("plan", JOB, "--connect")
    assert code == 1
    assert "server 127.0.0.1:1 refuses: " in output


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "$: 'tool' is a required property (required)"),
        ("no json", "not JSON"),
        (None, "cannot be read"),
    ],
)
def test_run_invalid_plan_file_states_path_and_keyword(
    ingest: Ingest, text: str | None, message: str
) -> None:
    if text is not None:
        Path("p.json").write_text(text)
    code, output = ingest("run", "--plan", "p.json")
    assert code == 2
    assert message in output
    assert "ingest plan job.yaml --out" in output


def test_run_without_manifest_and_plan_exits_2(ingest: Ingest) -> None:
    assert ingest("run")[0] == 2
    assert ingest("run", JOB, "--plan", "p.json")[0] == 2


def test_diff_prints_differences_and_exits_1(ingest: Ingest) -> None:
    shutil.copy(JOB, "configs/other.yaml")
    assert ingest("diff", JOB, "configs/other.yaml") == (0, "the plans are equal\n")
    edit("configs/other.yaml", "name: quickstart_{stem}", "name: other_{stem}")
    edit("configs/other.yaml", "target: {store: ../mosaico}", "target: {host: h}")
    edit("configs/other.yaml", "load: [quickstart/adapters/battery_pack.yaml]", "unmodeled: skip")
    code, output = ingest("diff", JOB, "configs/other.yaml")
    assert code == 1
    lines = output.splitlines()
    assert "quickstart_drive: sequence name: quickstart_drive → other_drive" in lines
    assert "quickstart_drive: destination: mosaico → h:6726" in lines
    assert any(line.startswith("quickstart_drive: - topic /battery: ") for line in lines)
    assert any(line.startswith("quickstart_drive: + excluded topic /battery: ") for line in lines)
    code, output = ingest("diff", JOB, "configs/other.yaml", "--json")
    assert code == 1
    assert {"sequence", "name", "before", "after"} == set(json.loads(output)[0])


def test_plan_matrix_plans_each_combination(ingest: Ingest) -> None:
    Path("night.yaml").write_text(
        "extends: configs/quickstart.yaml\nmatrix: {n: [1, 2]}\nsequence: {name: 'run_${n}'}\n"
    )
    code, output = ingest("plan", "night.yaml", "--json")
    assert code == 0
    plans = PlanDocument.model_validate_json(output).recordings
    assert [recording.plan["sequence"]["name"] for recording in plans] == ["run_1", "run_2"]
    code, output = ingest("expand", "night.yaml")
    assert code == 0
    assert "name: run_2\n" in output
    assert location("quickstart/drive.mcap").rpartition(":")[0] in output
    assert [job["sequence"]["name"] for job in json.loads(ingest("expand", "night.yaml", "--json")[1])] == [
        "run_1",
        "run_2",
    ]


def test_init_manifest_lints_clean_and_runs(ingest: Ingest) -> None:
    code, output = ingest("init", "configs/quickstart/drive.mcap", "--out", "job.yaml")
    assert code == 0
    assert "job.yaml: 10 topics" in output
    assert ingest("lint", "job.yaml")[0] == 0
    assert ingest("job.yaml", "-q")[0] == 0
    assert len(Store.open("mosaico").sequence("drive").topics) == 10
    text = Path("job.yaml").read_text()
    assert "# 1000 x sensor_msgs/msg/Imu at 100.0 Hz, IMU by IMUAdapter" in text
    assert ingest("init", "configs/quickstart/drive.mcap", "--out", "job.yaml")[0] == 2
    assert ingest("init", "configs/quickstart/drive.mcap", "--out", "job.yaml", "--force")[0] == 0
    assert ingest("init", "configs/quickstart/drive.mcap")[1].count("\n") > 30


def test_init_suggested_command_is_quoted(ingest: Ingest) -> None:
    _, output = ingest("init", "configs/quickstart/drive.mcap", "--out", "my job.yaml")
    assert "`ingest 'my job.yaml'`" in output


def test_init_recording_without_topics_exits_3(ingest: Ingest) -> None:
    with Writer("none.bag"):
        pass
    code, output = ingest("init", "none.bag", "--out", "job.yaml")
    assert (code, output) == (3, "error: none.bag: the recording has no topics\n")
    assert not Path("job.yaml").exists()


def test_plan_several_unusable_recordings_reports_each(ingest: Ingest) -> None:
    Path("a.mcap").write_text("no recording")
    shutil.copy("configs/quickstart/drive.mcap", "b.mcap")
    with Writer("c.bag"):
        pass
    Path("job.yaml").write_text('bag: {path: "[abc].*"}\n')
    code, output = ingest("plan", "job.yaml")
    assert code == 1
    assert "a.mcap: not a recording" in output
    assert "[plan-failed] c.bag: " in output
    Path("a.mcap").unlink()
    code, output = ingest("plan", "job.yaml", "--json")
    assert code == 3
    document, _, error = output.partition("error[plan-failed] c.bag: ")
    assert error
    assert [one["plan"]["sequence"]["name"] for one in json.loads(document)["recordings"]] == ["b"]


def test_plan_topics_without_messages_exits_3(ingest: Ingest) -> None:
    with Writer("quiet.bag") as writer:
        writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=get_typestore(Stores.ROS1_NOETIC))
    Path("job.yaml").write_text("bag: {path: quiet.bag}\n")
    code, output = ingest("plan", "job.yaml")
    assert code == 3
    assert "the selected topics have no message" in output
    assert ingest("job.yaml", "-q")[0] == 3


def test_plan_out_dash_prints_only_the_document(ingest: Ingest) -> None:
    code, output = ingest("plan", JOB, "--out", "-")
    assert code == 0
    assert PlanDocument.model_validate_json(output).recordings
    assert not Path("-").exists()


def test_init_out_dash_prints_the_manifest(ingest: Ingest) -> None:
    code, output = ingest("init", "configs/quickstart/drive.mcap", "--out", "-")
    assert code == 0
    assert output == ingest("init", "configs/quickstart/drive.mcap")[1]
    assert not Path("-").exists()


def test_expand_literal_secret_is_masked(ingest: Ingest) -> None:
    Path("secret.yaml").write_text(
        "version: 1\nbag: {path: configs/quickstart/drive.mcap}\nsequence: {name: a}\n"
        "target: {host: h, api_key: msco_s3cretkey}\n"
    )
    for options in ((), ("--json",)):
        code, output = ingest("expand", "secret.yaml", *options)
        assert code == 0
        assert "s3cretkey" not in output
        assert "***" in output


def test_plan_lines_are_checked_and_run_like_a_json_plan(ingest: Ingest) -> None:
    for name in ("a", "b"):
        shutil.copy("configs/quickstart/drive.mcap", f"{name}.mcap")
    manifest = (
        'bag: {path: "[ab].mcap"}\nsequence: {name: "{stem}"}\ntopics: [/imu]\ntarget: {store: lines}\n'
    )
    Path("job.yaml").write_text(manifest)
    assert ingest("plan", "job.yaml", "--out", "plan.jsonl")[0] == 0
    assert ingest("plan", "job.yaml", "--out", "plan.json")[0] == 0
    _, *lines = Path("plan.jsonl").read_text().splitlines()
    planned = json.loads(Path("plan.json").read_text())["recordings"]
    assert [json.loads(line)["plan"] for line in lines] == [one["plan"] for one in planned]
    assert ingest("plan", "job.yaml", "--check", "plan.jsonl") == (0, "the plans are equal\n")
    assert ingest("run", "--plan", "plan.jsonl", "--quiet")[0] == 0
    Path("job.yaml").write_text(manifest.replace("/imu", "/gps/fix"))
    assert ingest("plan", "job.yaml", "--check", "plan.jsonl")[0] == 1
