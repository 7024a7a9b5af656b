"""Lint, plan and run report the same mistake of a job with the same rule, location and exit code."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mosaico_ingest import api
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.manifest import check_manifest, load_manifest, read_manifest
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.compile import compile_manifest
from mosaico_ingest.pipeline.run import run_recording
from mosaico_ingest.pipeline.task import Task

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
OTHER = "version: 1\nadapter: Other\nros_type: sensor_msgs/msg/Imu\nontology: IMU\nfields: {angular_velocity: angular_velocity, acceleration: linear_acceleration}\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copy(DRIVE, tmp_path / "a.mcap")
    for name in ("one", "other"):
        (tmp_path / f"{name}.yaml").write_text(OTHER.replace("Other", name.title()))
    (tmp_path / "mine.py").write_text("VALUE = 1\n")
    return tmp_path


def manifest(text: str) -> Path:
    path = Path("job.yaml")
    path.write_text(f"bag: {{path: a.mcap}}\n{text}\n")
    return path


def located(findings: tuple[Finding, ...]) -> set[tuple[str, str]]:
    return {(finding.rule, str(finding.span)) for finding in findings if finding.severity.value == "error"}


@pytest.mark.parametrize(
    ("text", "rule", "location"),
    [
        ("adapters: {override: {/imu: IMUAdaptr}}", "unknown-adapter", "job.yaml:2:29"),
        ("adapters: {load: [nowhere.yaml]}", "missing-adapter", "job.yaml:2:19"),
        ('adapters: {load: ["nowhere.py:Adapter"]}', "missing-adapter", "job.yaml:2:19"),
        ('adapters: {load: ["no_such_module_at_all:Adapter"]}', "missing-adapter", "job.yaml:2:19"),
        ('adapters: {load: ["mine.py:Adapter"]}', "broken-adapter", "job.yaml:2:19"),
        ("adapters: {load: [one.yaml, other.yaml]}", "adapter-clash", "job.yaml:2:29"),
        ('adapters: {load: ["nothing*.yaml"]}', "missing-adapter", "job.yaml:2:19"),
        ('topics: [/imu, "/cam["]', "topic-pattern", "job.yaml:2:21"),
        ('topics: [/imu, "/cam.*"]', "topic-pattern", "job.yaml:2:21"),
        ('topics: [/imu, "!"]', "topic-pattern", "job.yaml:2:16"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_mistake_has_same_rule_location_and_message_in_lint_plan_and_run(
    text: str, rule: str, location: str
) -> None:
    assert_same_error(manifest(text), rule, location)


def assert_same_error(path: Path, rule: str, location: str) -> None:
    linted = [finding for finding in lint_paths([path], env={}).findings if finding.rule == rule]
    assert located(tuple(linted)) == {(rule, location)}
    for command in (lambda: api.plan_job(path), lambda: api.run(api.compile_job(path))):
        try:
            report = command()
        except IngestError as error:
            code, findings = error.exit_code, error.findings
        else:
            pytest.fail(f"no error: {report}")
        assert code == 2
        assert located(findings) == {(rule, location)}
        if rule != "broken-adapter":
            assert {finding.help for finding in findings} == {finding.help for finding in linted}


@pytest.mark.parametrize(
    ("text", "location"),
    [
        ("float64 a\nint32 b\nfloat64 a\n", "msgs/Twice.msg:3:9"),
        ("# twice\nstring a  # a\nstring<=5[]  a  # a\n", "msgs/Twice.msg:3:14"),
    ],
)
def test_field_defined_twice_has_same_rule_and_location_in_lint_plan_and_run(
    text: str, location: str, folder: Path
) -> None:
    (folder / "msgs").mkdir()
    (folder / "msgs" / "Twice.msg").write_text(text)
    path = folder / "job.yaml"
    path.write_text("bag: {path: a.mcap, custom_msgs: [{package: p, path: msgs}]}\ntarget: {store: s}\n")
    rule = "msg-repeated-name"
    assert (rule, location) in located(tuple(lint_paths([Path("job.yaml")], env={}).findings))
    for command in (api.plan_job, lambda job: run_recording(Task(*compile_manifest(load_manifest(job))))):
        try:
            error = command(Path("job.yaml")).error
        except IngestError as raised:
            error = raised
        assert error.exit_code == 2
        assert located(error.findings) == {(rule, location)}


@pytest.mark.usefixtures("folder")
def test_misspelled_default_of_topic_errors_suggests_default() -> None:
    path = manifest("on_error: {topic: {defualt: ignore}}")
    (finding,) = lint_paths([path], env={}).findings
    assert (finding.rule, str(finding.span)) == ("relative-topic", "job.yaml:2:20")
    assert str(finding.help).startswith("did you mean default?")
    planned = next(
        note for note in api.plan_job(path).recordings[0].notes if note.rule == "unmatched-pattern"
    )
    assert (planned.location, planned.help) == ("job.yaml:2:20", "the nearest is default")


@pytest.mark.parametrize(
    "window",
    ["{start: 2030-01-01}", "{end: 2020-01-01}", "{start: +1h}", "{start: +2s, end: +1s}", "{end: -1h}"],
)
@pytest.mark.usefixtures("folder")
def test_time_range_outside_recording_exits_with_3_in_plan_and_run(window: str) -> None:
    Path("job.yaml").write_text(f"bag: {{path: a.mcap, time: {window}}}\ntarget: {{store: s}}\n")
    with pytest.raises(IngestError) as caught:
        api.plan_job(Path("job.yaml"))
    (job,) = compile_manifest(load_manifest("job.yaml"))
    outcome = run_recording(Task(job))
    for error in (caught.value, outcome.error):
        assert error is not None
        assert error.exit_code == 3
        assert located(error.findings) == {("time-range-outside", "job.yaml:1:21")}


@pytest.mark.usefixtures("folder")
def test_topics_without_match_exit_with_3_and_location() -> None:
    with pytest.raises(IngestError) as caught:
        api.plan_job(manifest("topics: [/imuu]"))
    assert caught.value.exit_code == 3
    (finding,) = caught.value.findings
    assert (finding.rule, str(finding.span)) == ("unmatched-pattern", "job.yaml:2:1")
    assert "/imu;" in str(caught.value.hint)
    with pytest.raises(IngestError) as caught:
        api.plan_job(manifest('topics: [/imu, "!*"]'))
    assert str(caught.value.hint).startswith("put '!*' before '/imu'")


@pytest.mark.parametrize(
    ("text", "location"),
    [
        ("topic_settings: {/imu: {every: 99999999999999999999999}}", "job.yaml:2:32"),
        ("quarantine: {systematic: 99999999999999999999999}", "job.yaml:2:26"),
        ("quarantine: {max: 99999999999999999999999}", "job.yaml:2:19"),
        ("run: {jobs: 99999999999999999999999}", "job.yaml:2:13"),
        ("run: {memory: 99999999999999999TiB}", "job.yaml:2:15"),
        ("target: {host: h, port: 99999999999999999999999}", "job.yaml:2:25"),
        ("target: {host: h, message_size: 99999999999999999TiB}", "job.yaml:2:33"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_number_out_of_bounds_is_a_mistake_of_the_manifest(text: str, location: str) -> None:
    _, findings = check_manifest(read_manifest(manifest(text)), env={})
    assert located(findings) == {("wrong-value", location)}


@pytest.mark.parametrize("time", ["9999-12-31", "+999999999999999999h", "1500-01-01"])
@pytest.mark.usefixtures("folder")
def test_time_out_of_bounds_is_a_mistake_of_the_manifest(time: str) -> None:
    Path("job.yaml").write_text(f"bag: {{path: a.mcap, time: {{start: {time}}}}}\n")
    _, findings = check_manifest(read_manifest(Path("job.yaml")), env={})
    assert located(findings) == {("wrong-value", "job.yaml:1:35")}


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("topic_settings: {/imu: {every: 1.5}}", "write a whole number, such as 2"),
        ("topics: /imu", 'write ["/imu"]'),
        ("matrix: {a: []}\nsequence: {name: 'x_${a}'}", "give it a value, or remove the key"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_hint_of_wrong_value_shows_a_valid_one(text: str, hint: str) -> None:
    _, findings = check_manifest(read_manifest(manifest(text)), env={})
    assert [finding.help for finding in findings] == [hint]


@pytest.mark.usefixtures("folder")
def test_hint_for_list_of_mappings_shows_required_keys() -> None:
    Path("job.yaml").write_text("bag: {path: a.mcap, custom_msgs: definitions}\n")
    (finding,) = check_manifest(read_manifest(Path("job.yaml")), env={})[1]
    assert finding.help == "write [{package: my_custom_pkg, path: definitions/my_pkg}]"


@pytest.mark.usefixtures("folder")
def test_sequence_name_of_parent_folder_is_its_name() -> None:
    Path("inner").mkdir()
    Path("inner/job.yaml").write_text("bag: {path: ..}\n")
    (job,) = compile_manifest(load_manifest("inner/job.yaml"))
    assert job.sequence.name == Path.cwd().name
