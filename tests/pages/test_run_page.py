"""The page of a run contains the whole report, escaped and compact."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest
from run_reports import NASTY, RUNS, T0, Outline, recording, run, unpacked
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.findings import Severity
from mosaico_ingest.pages.recording import VALUE_WIDTH, RecordingView
from mosaico_ingest.pages.run import MAX_OPEN, run_page
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.parts import ContractResult, ExpectationResult, Occurrence, Outcome
from mosaico_ingest.report.recording import Steps, UnreadableRange
from mosaico_ingest.report.run import read_report
from mosaico_ingest.report.summaries import compare_reports, markdown_summary
from mosaico_ingest.rosbag.loader import ROSLoader
from mosaico_ingest.view.texts import value_text

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", RUNS)
def test_run_page_any_run_is_well_formed_and_self_contained(name: str) -> None:
    outline = Outline(run_page(RUNS[name]))
    assert outline.open == []
    assert outline.loads == []
    assert len(outline.ids) == len(set(outline.ids))
    assert {link for link in outline.links if not link.startswith("#")} <= {"kept%20here/"}
    assert {link[1:] for link in outline.links if link.startswith("#")} <= set(
        Outline(unpacked(run_page(RUNS[name]))).ids
    )


def test_run_page_contains_every_recording_topic_rejection_and_unreadable_range() -> None:
    text = " ".join(Outline(run_page(RUNS["failing"])).words)
    for expected in ("drive_001", "drive_003", "/sensor_0", "[null]", "bad checksum", "a note", NASTY):
        assert expected in text


def test_run_page_contains_manifest_steps_and_replay_command(tmp_path: Path) -> None:
    outline = Outline(run_page(RUNS["failing"], tmp_path))
    text = " ".join(outline.words)
    assert "api_key: " in text
    assert "Time by step" in text
    assert "Slowest recordings" in text
    assert "ingest replay 'kept here' --manifest jobs/nightly.yaml" in text
    (link,) = {link for link in outline.links if not link.startswith("#")}
    assert (tmp_path / unquote(link)).resolve() == Path("kept here").resolve()


def test_run_page_without_steps_and_manifests_has_no_empty_sections() -> None:
    old = RUNS["small"].model_copy(
        update={
            "manifests": (),
            "recordings": tuple(
                one.model_copy(update={"steps": Steps()}) for one in RUNS["small"].recordings
            ),
        }
    )
    text = " ".join(Outline(run_page(old)).words)
    assert "Time by step" not in text
    assert "Manifest" not in text


def test_run_page_markup_in_texts_is_escaped() -> None:
    assert "<script>alert" not in run_page(RUNS["failing"])


def test_run_page_of_500_recordings_is_below_300_kb_and_contains_all_of_them() -> None:
    page = run_page(RUNS["large"])
    assert len(page) < 300_000
    complete = unpacked(page)
    assert {f"r{at}" for at in range(500)} <= set(Outline(complete).ids)
    assert len(re.findall('aria-label="/sensor_3: ', complete)) == sum(
        bool(one.topics) for one in RUNS["large"].recordings
    )


def test_run_page_control_characters_in_texts_are_escaped() -> None:
    report = run(
        recording(1).model_copy(update={"sequence": "a\x1b[2Jb", "error": "x\u202ey", "findings": ("\x00",)})
    )
    page = run_page(report)
    assert not set("\x1b\u202e\x00") & set(page)
    assert "a\\x1b[2Jb" in page
    assert "\x1b" not in markdown_summary(report)


def test_run_page_opens_recordings_with_problems_and_collapses_healthy_ones() -> None:
    unreadable = UnreadableRange(topic=None, count=None, offset=99, reason="bad checksum")
    truncated = recording(4, RunStatus.WITH_ERRORS).model_copy(
        update={"topics": (), "unreadable_ranges": (unreadable,)}
    )
    page = run_page(
        run(recording(1), recording(2, RunStatus.FAILED), recording(3, RunStatus.SKIPPED), truncated)
    )
    opened = [
        part.split('"')[1]
        for part in page.split('<details class="recording" id=')[1:]
        if " open" in part.split(">")[0]
    ]
    problems = [
        part.split('"')[1]
        for part in page.split('<details class="recording" id=')[1:]
        if "data-rank" in part.split(">")[0]
    ]
    assert sorted(opened) == sorted(problems) == ["r1", "r3"]
    assert "unknown unreadable" in page


def test_run_page_single_healthy_recording_is_open() -> None:
    assert '<details class="recording" id="r0" open' in run_page(run(recording(1)))


def test_run_page_stored_size_states_share() -> None:
    page = run_page(run(recording(1)))
    assert "(stored in 200.0 kB (4 % of 5.0 MB))" in page


def test_markdown_summary_lists_problems_first_and_escapes_cells() -> None:
    lines = markdown_summary(RUNS["failing"]).splitlines()
    assert lines[0] == "## Ingestion: 3 recordings, 1 failed, 4,000 messages written"
    assert lines[4].startswith("| drive_001 | failed")
    assert any("\\<script\\>" in line for line in lines)
    assert any(line.startswith("Slowest: drive_003 4.50 s (reading, ") for line in lines)
    assert "    ingest replay 'kept here' --manifest jobs/nightly.yaml" in lines
    assert len(markdown_summary(RUNS["large"]).splitlines()) < 250


def test_report_command_writes_page_and_summary(tmp_path: Path) -> None:
    source = tmp_path / "run.json"
    source.write_text(RUNS["small"].model_dump_json())
    page, summary = tmp_path / "out.html", tmp_path / "out.md"
    result = CliRunner().invoke(
        command_line(), ["report", str(source), "--html", str(page), "--markdown", str(summary)]
    )
    assert result.exit_code == 0, result.output
    assert page.read_text() == run_page(RUNS["small"], tmp_path)
    assert summary.read_text() == markdown_summary(RUNS["small"])


@pytest.mark.parametrize("option", ["--html", "--markdown"])
def test_report_command_dash_writes_to_stdout(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.json").write_text(RUNS["small"].model_dump_json())
    result = CliRunner().invoke(command_line(), ["report", "run.json", option, "-"])
    assert result.exit_code == 0, result.output
    expected = run_page(RUNS["small"]) if option == "--html" else markdown_summary(RUNS["small"])
    assert result.stdout == expected
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_run_page_verdict_names_failures_and_what_to_do() -> None:
    outline = Outline(run_page(RUNS["failing"]))
    text = " ".join(outline.words)
    assert text.index("The run failed for some recordings") < text.index("What needs attention")
    assert text.index("What needs attention") < text.index("Recordings")
    assert "a null in a column that requires a value" in text


@pytest.mark.parametrize(("name", "kind"), [("empty", "none"), ("small", "good"), ("failing", "bad")])
def test_run_page_verdict_has_the_color_of_the_outcome(name: str, kind: str) -> None:
    assert f'<section class="verdict {kind}"' in run_page(RUNS[name])


def test_run_page_equal_problems_of_many_recordings_are_one_problem() -> None:
    failed = [
        recording(at, RunStatus.FAILED).model_copy(
            update={"error": f"drive_{at}.bag: the disk is full at byte {at} — free some space"}
        )
        for at in range(30)
    ]
    page = run_page(run(*failed))
    assert page.count("Free some space.") == 1
    assert "in 30 recordings" in page


def test_run_page_shows_changes_since_the_earlier_run() -> None:
    before, after = run(recording(1, topics=3)), run(recording(1, topics=2))
    page = run_page(after, comparison=compare_reports(after, before))
    assert "Changes since the earlier run" in page
    assert "missing now" in page
    assert "no changes" in run_page(after, comparison=compare_reports(after, after))


def test_run_page_shows_quarantined_examples(tmp_path: Path) -> None:
    entry = '{"topic": "/imu", "target": "/imu", "rule": "null", "log_time_ns": 5, "offset": 7, "bytes": 9, "reason": "no <b>x</b>"}'
    (tmp_path / "q.jsonl").write_text(f"{entry}\n" * 5 + "not JSON\n")
    report = recording(1, RunStatus.WITH_ERRORS).model_copy(update={"quarantine": str(tmp_path / "q.mcap")})
    page = run_page(run(report))
    assert page.count("no &lt;b&gt;x&lt;/b&gt;") == 3


def test_run_page_permits_only_its_own_scripts() -> None:
    page = run_page(RUNS["small"])
    policy = re.search('Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    assert "default-src &#39;none&#39;" in policy[1]
    assert "unsafe-inline" not in policy[1].split("script-src")[1]


def test_report_command_compare_lists_changes_on_all_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("last.json").write_text(run(recording(1, topics=3)).model_dump_json())
    Path("run.json").write_text(run(recording(1, topics=2)).model_dump_json())
    words = ["report", "run.json", "--compare", "last.json"]
    for options in ([], ["--html", "-"], ["--markdown", "-"]):
        result = CliRunner().invoke(command_line(), [*words, *options])
        assert result.exit_code == 0, result.output
        assert "/sensor_1" in result.stdout
        assert "missing now" in result.stdout


def expectation(topic: str, outcome: Outcome) -> ExpectationResult:
    return ExpectationResult(
        expectation="expect.topics./imu.rate",
        severity=Severity.ERROR,
        outcome=outcome,
        text=f"the rate of {topic} is 3 Hz <b>",
        topic=topic,
        first=Occurrence(log_time_ns=T0),
    )


def test_run_page_contract_results_are_counted_per_expectation_and_violations_are_problems() -> None:
    recordings = [
        recording(at).model_copy(
            update={
                "contract": ContractResult(
                    on_failure="warn",
                    results=(expectation("/imu", Outcome.FAILED if at == 3 else Outcome.PASSED),),
                )
            }
        )
        for at in range(60)
    ]
    page = run_page(run(*recordings))
    assert "1 failed, 59 passed" in page
    assert "The data violate the contract" in page
    assert page.index("Expectation expect.topics./imu.rate failed") < page.index('id="contract-title"')
    assert "3 Hz &lt;b&gt;" in page
    assert '<a href="#r3">drive_003</a>' in page
    assert "2023-11-14 22:13:20.000" in page
    # The list of all recordings repeats the open recordings, which the page shows without scripts.
    assert unpacked(page).count("<h3>Contract</h3>") == 60 + MAX_OPEN


@pytest.mark.slow
def test_report_command_1000_recordings_need_less_than_200_mb_and_5_s_of_cpu(tmp_path: Path) -> None:
    template = recording(1, topics=9)
    copies = [template.replace(sequence=f"drive_{at:04}") for at in range(1000)]
    report, page = tmp_path / "run.json", tmp_path / "run.html"
    report.write_text(run(*copies).model_dump_json(indent=2) + "\n")
    # The child of this process would start with the memory of the tests, so it starts a process itself and measures that.
    program = (
        "import os, resource, subprocess, sys\n"
        "subprocess.run([sys.executable, '-m', 'mosaico_ingest', *sys.argv[1:]], check=True)\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(used.ru_maxrss, used.ru_utime + used.ru_stime)"
    )
    words = [sys.executable, "-c", program, "report", str(report), "--html", str(page)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)  # noqa: S603 - a program of ours
    peak_kib, cpu_s = map(float, done.stdout.split())
    assert peak_kib < 200_000_000 / 1024
    assert cpu_s < 5
    assert page.stat().st_size < 1_000_000


def test_run_page_quarantined_message_that_can_be_decoded_shows_its_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    words = ["run", "-q", "configs/examples/quarantine.yaml", "--report", "run.json"]
    result = CliRunner().invoke(command_line(), words)
    assert result.exit_code == 4, result.output
    (one,) = read_report(Path("run.json")).recordings
    rejected = next(topic for topic in one.topics if topic.quarantined)
    with ROSLoader("configs/quickstart/drive.mcap", topics=rejected.topic) as messages:
        values = {each.timestamp_ns: value_text(each.data, VALUE_WIDTH) for each, _ in messages}
    examples = RecordingView(0, run(one), tmp_path).examples
    assert examples
    assert [example.values for example in examples] == [values[example.log_time_ns] for example in examples]
