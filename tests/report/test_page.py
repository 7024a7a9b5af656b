"""The report page and the Markdown summary contain the whole report, escaped; Chromium renders the page if present."""

from __future__ import annotations

import shutil
import subprocess
from datetime import datetime, timezone
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.findings import Stage
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.html import draw_topic, html_page
from mosaico_ingest.report.markdown import markdown_summary
from mosaico_ingest.report.model import (
    Rejection,
    Report,
    RunReport,
    Steps,
    TopicReport,
    UnreadableRange,
    UsedManifest,
)
from mosaico_ingest.report.timing import Gap, TimelineReport

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
VOID = {"meta", "input", "path"}
NASTY = "<script>alert('|x|')</script> & \"quoted\""
MANIFEST = 'version: 1\nbag:\n  path: drives/*.mcap\ntarget:\n  api_key: "***"\n'
T0 = 1_700_000_000 * 10**9


def topic(name: str, *, rejected: int = 0, counts: tuple[int, ...] = (50,) * 20) -> TopicReport:
    rejections = (
        Rejection(
            stage=Stage.ADAPT, rule="nan", count=rejected, reason=NASTY, first_log_time_ns=T0, first_offset=7
        ),
    )
    return TopicReport(
        topic=name,
        target=name,
        msgtype="sensor_msgs/msg/Imu",
        adapter="IMUAdapter",
        ontology="IMU",
        why="built-in",
        status=TopicStatus.WRITTEN,
        promised=sum(counts) + rejected,
        read=sum(counts) + rejected,
        written=sum(counts),
        rejected=rejected,
        quarantined=rejected,
        rejections=rejections if rejected else (),
        start_ns=T0,
        end_ns=T0 + len(counts) * 10**9,
        payload_bytes=10**6,
        stored_bytes=10**5,
        timeline=TimelineReport(start_ns=T0, step_ns=10**9, counts=counts, interval_ns=20_000_000),
    )


def recording(number: int, status: RunStatus = RunStatus.COMPLETED, topics: int = 2) -> Report:
    failed = status is RunStatus.FAILED
    gap = (50,) * 6 + (0,) * 6 + (20,) * 8
    topic_reports = [
        topic(f"/sensor_{at}", counts=gap if at == 1 else (50,) * 20) for at in range(topics - 1)
    ]
    topic_reports.append(topic("/imu", rejected=3 if status is RunStatus.WITH_ERRORS else 0))
    return Report(
        sequence=f"drive_{number:03}",
        destination="mosaico",
        files=(f"drives/{NASTY if failed else number}.mcap",),
        status=status,
        exit_code={RunStatus.FAILED: 1, RunStatus.WITH_ERRORS: 4}.get(status, 0),
        error=f"drive.mcap: {NASTY}" if failed else None,
        started_at=datetime(2026, 3, 1, tzinfo=timezone.utc),
        duration_s=1.5 + number % 7,
        source_bytes=5 * 10**6,
        steps=Steps()
        if failed
        else Steps(prepare=0.1, read=0.6, decode=0.3, adapt=0.2, commit=0.3, write=0.4),
        quarantine="kept here/drive-1.mcap" if status is RunStatus.WITH_ERRORS else None,
        topics=() if failed else tuple(topic_reports),
        unreadable_ranges=(UnreadableRange(topic=None, count=4, offset=99, reason="bad checksum"),)
        if failed
        else (),
        findings=("a note",),
    )


def run(*recordings: Report) -> RunReport:
    manifests = (UsedManifest(path="jobs/nightly.yaml", text=MANIFEST),) if recordings else ()
    return RunReport(tool="mosaico-ingest 0", manifests=manifests, recordings=recordings)


def mixed(number: int) -> Report:
    status = {7: RunStatus.FAILED, 5: RunStatus.WITH_ERRORS, 3: RunStatus.SKIPPED}.get(
        number % 40, RunStatus.COMPLETED
    )
    return recording(number, status, topics=6)


RUNS = {
    "empty": run(),
    "small": run(recording(1), recording(2)),
    "large": run(*map(mixed, range(500))),
    "failing": run(recording(1, RunStatus.FAILED), recording(2, RunStatus.WITH_ERRORS), recording(3)),
}


class Outline(HTMLParser):
    """Checks that elements close in order, and keeps ids, links and text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.loads: list[str] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.ids += [value for key, value in attrs if key == "id" and value]
        self.links += [value for key, value in attrs if key == "href" and value]
        self.loads += [str(attributes[key]) for key in ("src", "srcset", "data") if key in attributes]
        if tag not in VOID or tag == "path":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.mark.parametrize("name", RUNS)
def test_html_page_any_run_is_well_formed_and_self_contained(name: str) -> None:
    outline = Outline(html_page(RUNS[name]))
    assert outline.open == []
    assert outline.loads == []
    assert len(outline.ids) == len(set(outline.ids))
    assert {link for link in outline.links if not link.startswith("#")} <= {"kept%20here/"}
    assert {link[1:] for link in outline.links if link.startswith("#")} <= set(outline.ids)


def test_html_page_contains_every_recording_topic_rejection_and_unreadable_range() -> None:
    text = " ".join(Outline(html_page(RUNS["failing"])).words)
    for expected in ("drive_001", "drive_003", "/sensor_0", "nan", "bad checksum", "a note", NASTY):
        assert expected in text


def test_html_page_contains_manifest_steps_and_replay_command(tmp_path: Path) -> None:
    outline = Outline(html_page(RUNS["failing"], tmp_path))
    text = " ".join(outline.words)
    assert "api_key: " in text
    assert "Time by step" in text
    assert "Slowest recordings" in text
    assert "ingest replay 'kept here' --manifest jobs/nightly.yaml" in text
    (link,) = {link for link in outline.links if not link.startswith("#")}
    assert (tmp_path / unquote(link)).resolve() == Path("kept here").resolve()


def test_html_page_without_steps_and_manifests_has_no_empty_sections() -> None:
    old = RUNS["small"].model_copy(
        update={
            "manifests": (),
            "recordings": tuple(
                one.model_copy(update={"steps": Steps()}) for one in RUNS["small"].recordings
            ),
        }
    )
    text = " ".join(Outline(html_page(old)).words)
    assert "Time by step" not in text
    assert "Manifest" not in text


def test_html_page_markup_in_texts_is_escaped() -> None:
    assert "<script>alert" not in html_page(RUNS["failing"])


def test_html_page_of_500_recordings_is_below_6_mb() -> None:
    assert len(html_page(RUNS["large"])) < 6_000_000


def test_html_page_control_characters_in_texts_are_escaped() -> None:
    report = run(
        recording(1).model_copy(update={"sequence": "a\x1b[2Jb", "error": "x\u202ey", "findings": ("\x00",)})
    )
    page = html_page(report)
    assert not set("\x1b\u202e\x00") & set(page)
    assert "a\\x1b[2Jb" in page
    assert "\x1b" not in markdown_summary(report)


def test_html_page_opens_recordings_with_problems_and_collapses_healthy_ones() -> None:
    unreadable = UnreadableRange(topic=None, count=None, offset=99, reason="bad checksum")
    truncated = recording(4, RunStatus.WITH_ERRORS).model_copy(
        update={"topics": (), "unreadable_ranges": (unreadable,)}
    )
    page = html_page(
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
        if "data-problem" in part.split(">")[0]
    ]
    assert opened == problems == ["r1", "r3"]
    assert "unknown unreadable" in page


def test_html_page_single_healthy_recording_is_open() -> None:
    assert '<details class="recording" id="r0" open' in html_page(run(recording(1)))


def test_html_page_stored_size_states_share() -> None:
    page = html_page(run(recording(1)))
    assert "(5.0 MB, stored in 200.0 kB (4 %))" in page


def test_draw_topic_one_gap_is_labelled_and_drawn() -> None:
    timeline = TimelineReport(
        start_ns=0,
        step_ns=10**9,
        counts=(10,) * 20,
        interval_ns=10**8,
        gap_count=1,
        gaps=(Gap(start_ns=5 * 10**9, end_ns=7_200_000_000),),
    )
    drawing = draw_topic(topic("/a").model_copy(update={"timeline": timeline}), (0, 20 * 10**9))
    assert drawing is not None
    assert drawing["label"] == "/a: 1,000 rows, 1 gap, 2.20 s"
    assert drawing["gaps"] == "M60.0 21H86.4V24H60.0Z"


def test_draw_topic_single_row_is_visible() -> None:
    timeline = TimelineReport(start_ns=10**10, step_ns=10**6, counts=(1,))
    for span in ((0, 10**10), (10**10, 10**10)):
        drawing = draw_topic(topic("/a").model_copy(update={"timeline": timeline, "written": 1}), span)
        assert drawing is not None
        assert drawing["label"] == "/a: 1 row, no gaps"
        left, right = (
            float(part.split("V")[0].split(" ")[0]) for part in drawing["rows"][1:].split("H")[::2]
        )
        assert 0 <= left < right <= 240
        assert right - left >= 1.9


def test_draw_topic_slow_regular_topic_has_no_empty_bars() -> None:
    timeline = TimelineReport(
        start_ns=0, step_ns=10**9, counts=((1, 0, 0) * 30 + (1,)), interval_ns=3 * 10**9
    )
    drawing = draw_topic(topic("/a").model_copy(update={"timeline": timeline}), (0, 90 * 10**9))
    assert drawing is not None
    assert "V24H" not in drawing["rows"]


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
    done = CliRunner().invoke(
        command_line(), ["report", str(source), "--html", str(page), "--markdown", str(summary)]
    )
    assert done.exit_code == 0, done.output
    assert page.read_text() == html_page(RUNS["small"], tmp_path)
    assert summary.read_text() == markdown_summary(RUNS["small"])


@pytest.mark.parametrize("option", ["--html", "--markdown"])
def test_report_command_dash_writes_to_stdout(
    option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.json").write_text(RUNS["small"].model_dump_json())
    done = CliRunner().invoke(command_line(), ["report", "run.json", option, "-"])
    assert done.exit_code == 0, done.output
    expected = html_page(RUNS["small"]) if option == "--html" else markdown_summary(RUNS["small"])
    assert done.stdout == expected
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", RUNS)
def test_chromium_renders_page_and_runs_filter(name: str, scheme: str, tmp_path: Path) -> None:
    page, picture = tmp_path / f"{name}.html", tmp_path / f"{name}-{scheme}.png"
    page.write_text(html_page(RUNS[name]))
    dark = ["--blink-settings=preferredColorScheme=0"] if scheme == "dark" else []
    dump = chromium(page, tmp_path, "--dump-dom", *dark)
    assert ("recordings</span>" in dump) == bool(RUNS[name].recordings)  # the script has counted them
    chromium(page, tmp_path, f"--screenshot={picture}", "--window-size=1200,1600", *dark)
    assert picture.stat().st_size > 5_000


def chromium(page: Path, profile: Path, *arguments: str) -> str:
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        f"--user-data-dir={profile}/p",
    )
    done = subprocess.run(  # noqa: S603 - a browser, on a page of ours
        [str(CHROMIUM), *options, *arguments, page.as_uri()],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return done.stdout
