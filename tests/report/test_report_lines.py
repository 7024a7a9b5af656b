"""Report files in JSON Lines: streaming, continuing an interrupted run, and reading."""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from mosaico_ingest import api
from mosaico_ingest.cli.app import command_line
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import ManifestError, SinkError
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.recording import Report
from mosaico_ingest.report.run import Header, ReportWriter, RunReport, combine, read_report, report_text
from mosaico_ingest.report.summaries import prometheus_text
from tests.support.run_reports import RUNS, recording

DRIVE = Path(__file__).parents[2] / "configs/quickstart/drive.mcap"
HEADER = Header(tool="mosaico-ingest 0")


@pytest.fixture
def job(tmp_path: Path) -> Path:
    for name in ("a", "b", "c"):
        shutil.copy(DRIVE, tmp_path / f"{name}.mcap")
    time.sleep(0.1)  # files that changed a moment ago are not recognized by their times
    manifest = tmp_path / "job.yaml"
    manifest.write_text(
        'bag: {path: "*.mcap"}\nsequence: {name: "{stem}"}\ntopics: [/imu]\ntarget: {store: store}\n'
    )
    return manifest


def ingest(*arguments: str | Path) -> Result:
    return CliRunner().invoke(command_line(), [str(argument) for argument in arguments])


def write(path: Path, *recordings: Report, resume: bool = False) -> RunReport:
    with ReportWriter(path, HEADER, resume=resume) as writer:
        for each in recordings:
            writer.add(each)
        return writer.finish()


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("suffix", [".jsonl", ".json"])
def test_report_text_is_read_as_the_same_report(name: str, suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"run{suffix}"
    file.write_text("".join(report_text(RUNS[name], file)))
    report = read_report(file)
    assert tuple(report.recordings) == RUNS[name].recordings
    assert (report.tool, report.manifests) == (RUNS[name].tool, RUNS[name].manifests)
    assert report.summary == RUNS[name].summary


def test_report_document_equals_the_serialized_model(tmp_path: Path) -> None:
    for run in RUNS.values():
        assert "".join(report_text(run, tmp_path / "run.json")) == run.model_dump_json(indent=2) + "\n"


def test_report_writer_appends_each_recording_when_it_ends(tmp_path: Path) -> None:
    file = tmp_path / "run.jsonl"
    with ReportWriter(file, HEADER) as writer:
        for count in range(1, 4):
            writer.add(recording(count))
            assert len(read_report(file).recordings) == count
        assert writer.finish().summary == read_report(file).summary
    assert list(json.loads(file.read_text().splitlines()[-1])) == ["summary"]


def test_report_writer_resuming_keeps_finished_lines_and_replaces_others(tmp_path: Path) -> None:
    file = tmp_path / "run.jsonl"
    write(file, recording(1), recording(2, RunStatus.FAILED), recording(3))
    with file.open("a") as lines:
        lines.write('{"sequence": "drive_00')  # the writer was killed
    skipped = recording(1).replace(status=RunStatus.SKIPPED, topics=())
    report = write(file, skipped, recording(2), recording(3, RunStatus.WITH_ERRORS), resume=True)
    assert tuple(report.recordings) == (recording(1), recording(2), recording(3, RunStatus.WITH_ERRORS))
    assert (report.summary.resumed, report.exit_code) == (1, 4)
    assert report.summary.statuses == {RunStatus.COMPLETED: 2, RunStatus.WITH_ERRORS: 1}
    assert tuple(read_report(file).recordings) == tuple(report.recordings)


def test_report_writer_without_resume_replaces_the_file(tmp_path: Path) -> None:
    write(tmp_path / "run.jsonl", recording(1))
    assert [one.sequence for one in write(tmp_path / "run.jsonl", recording(2)).recordings] == ["drive_002"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such lock")
@pytest.mark.parametrize("resume", [False, True])
def test_report_writer_beside_another_one_is_refused(*, resume: bool, tmp_path: Path) -> None:
    file = tmp_path / "run.jsonl"
    with ReportWriter(file, HEADER) as writer:
        writer.add(recording(1))
        with pytest.raises(SinkError, match="another run") as caught:
            ReportWriter(file, HEADER, resume=resume)
        assert caught.value.where == str(file)
        writer.add(recording(2))
        writer.finish()
    assert list(read_report(file).recordings) == [recording(1), recording(2)]
    assert len(write(file, recording(3), resume=resume).recordings) == (3 if resume else 1)


def test_combined_reports_have_the_recordings_and_sums_of_all(tmp_path: Path) -> None:
    write(tmp_path / "a.jsonl", recording(1), recording(2, RunStatus.FAILED))
    combined = combine([read_report(tmp_path / "a.jsonl"), RUNS["small"]])
    assert [one.sequence for one in combined.recordings] == ["drive_001", "drive_002"] * 2
    assert (combined.exit_code, combined.summary.statuses[RunStatus.COMPLETED]) == (1, 3)
    assert 'mosaico_ingest_recordings{status="failed"} 1\n' in prometheus_text(combined)


@pytest.mark.parametrize(
    ("content", "where"),
    [
        ("x\n", "run.jsonl"),
        ('{"sequence": "a"}\n', "run.jsonl: line 1"),
        ('{"tool": "t"}\n{"summary": 1}\n', "run.jsonl: line 2"),
    ],
)
def test_file_that_is_no_report_is_refused_and_not_continued(
    content: str, where: str, tmp_path: Path
) -> None:
    file = tmp_path / "run.jsonl"
    file.write_text(content)
    for read in (lambda: read_report(file), lambda: write(file, recording(1), resume=True)):
        with pytest.raises(ManifestError) as caught:
            read()
        assert str(caught.value.where).endswith(where)
    assert file.read_text() == content


def test_damaged_line_is_reported_with_its_position(tmp_path: Path) -> None:
    file = tmp_path / "run.jsonl"
    file.write_text('{"tool": "t"}\n{"sequence": "a"}\n')
    with pytest.raises(ManifestError) as caught:
        list(read_report(file).recordings)
    assert str(caught.value.where).endswith("run.jsonl: byte 14")


def test_report_that_cannot_be_written_ends_the_run(job: Path) -> None:
    (job.parent / "full.jsonl").symlink_to("/dev/full")
    with pytest.raises(SinkError):
        api.run(job, report=job.parent / "full.jsonl")


def test_run_killed_and_resumed_reports_each_recording_once(job: Path) -> None:
    file = job.parent / "run.jsonl"
    api.run(job, report=file)
    header, first, second, *_ = file.read_text().splitlines(keepends=True)
    file.write_text(header + first + second[:50])  # killed between a commit and its line
    shutil.rmtree(job.parent / "store")
    api.run(tuple(api.compile_job(job))[:2])
    result = ingest("run", job, "--report", file, "--resume", "--quiet")
    assert result.exit_code == 0, result.output
    report = read_report(file)
    statuses = {one.sequence: one.status for one in report.recordings}
    assert statuses == {"a": RunStatus.COMPLETED, "b": RunStatus.SKIPPED, "c": RunStatus.COMPLETED}
    assert report.headline.startswith("3 recordings, 0 failed, 1 from earlier runs, 1 skipped")


def test_resume_skips_finished_recordings_that_a_job_would_replace(job: Path) -> None:
    job.write_text(job.read_text().replace('"{stem}"', '"{stem}", if_exists: replace'))
    file = job.parent / "run.jsonl"
    before = api.run(job, report=file)
    after = api.run(job, report=file, resume=True)
    assert tuple(after.recordings) == tuple(before.recordings)
    assert after.summary == before.summary.replace(resumed=3)


def test_resume_appends_no_recording_twice_whose_line_is_missing(job: Path) -> None:
    job.write_text(job.read_text().replace('"{stem}"', '"{stem}", if_exists: append'))
    file = job.parent / "run.jsonl"
    api.run(job, report=file)
    header, first, *_ = file.read_text().splitlines(keepends=True)
    file.write_text(header + first)  # killed between a commit and its line
    report = api.run(job, report=file, resume=True)
    assert [one.status for one in report.recordings] == [RunStatus.COMPLETED, *[RunStatus.SKIPPED] * 2]
    assert [info.rows for info in Store.open(job.parent / "store").sequences()] == [1000] * 3


def test_resume_continues_the_report_of_the_command_line(job: Path) -> None:
    other, file = job.parent / "a.jsonl", job.parent / "b.jsonl"
    job.write_text(f"{job.read_text()}run: {{report: {other}}}\n")
    api.run(job, report=file)
    write(other, recording(1))
    assert ingest("run", job, "--report", file, "--resume", "--quiet").exit_code == 0
    assert [one.sequence for one in read_report(other).recordings] == ["a", "b", "c"]
    assert read_report(file).summary.resumed == 3


def test_resume_without_lines_is_refused(job: Path) -> None:
    assert ingest("run", job, "--resume", "--report", job.parent / "run.json").exit_code == 2


def test_resume_with_the_report_of_another_job_is_refused_and_keeps_the_report(job: Path) -> None:
    other, file = job.with_name("other.yaml"), job.parent / "run.jsonl"
    api.run(job, report=file)
    lines = file.read_bytes()
    other.write_text(job.read_text().replace("{stem}", "{stem}_again"))
    with pytest.raises(ManifestError, match=r"job\.yaml, not of .*other\.yaml"):
        api.run(other, report=file, resume=True)
    assert file.read_bytes() == lines
    job.rename(other)  # the same content under another name
    assert api.run(other, report=file, resume=True).summary.resumed == 3


def test_resume_of_manifests_that_write_one_sequence_is_refused(job: Path) -> None:
    job.write_text(job.read_text().replace('"{stem}"', '"{stem}", if_exists: append'))
    second = job.with_name("second.yaml")
    second.write_text(job.read_text().replace("/imu", "/gps/fix"))
    file = job.parent / "run.jsonl"
    arguments = ("run", job, second, "--report", file, "--quiet")
    assert ingest(*arguments).exit_code == 0
    result = CliRunner().invoke(command_line(), [*map(str, arguments), "--resume"])
    assert isinstance(result.exception, ManifestError)
    assert "'a'" in str(result.exception)
    assert len(read_report(file).recordings) == 6
