"""Reports of runs with every kind of outcome, and a parser for the pages that show them."""

from __future__ import annotations

import base64
import json
import re
import zlib
from datetime import datetime, timezone
from html.parser import HTMLParser

from mosaico_ingest.findings import Stage
from mosaico_ingest.report.events import RunStatus, TopicStatus
from mosaico_ingest.report.parts import TimelineReport
from mosaico_ingest.report.recording import Rejection, Report, Steps, Stretch, TopicReport, UnreadableRange
from mosaico_ingest.report.run import RunReport, UsedManifest

VOID = {"meta", "link", "input", "path", "img", "br"}
NASTY = "<script>alert('|x|')</script> & \"quoted\""
MANIFEST = 'version: 1\nbag:\n  path: drives/*.mcap\ntarget:\n  api_key: "***"\n'
T0 = 1_700_000_000 * 10**9


def topic(name: str, *, rejected: int = 0, counts: tuple[int, ...] = (50,) * 20) -> TopicReport:
    rejections = (
        Rejection(
            stage=Stage.ADAPT,
            rule="null",
            count=rejected,
            reason=NASTY,
            first_log_time_ns=T0,
            first_offset=7,
            stretches=(Stretch(start_ns=T0 + 2 * 10**9, end_ns=T0 + 4 * 10**9),),
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
        rows=sum(counts),
        rejected=rejected,
        quarantined=rejected,
        rejections=rejections if rejected else (),
        start_ns=T0,
        end_ns=T0 + len(counts) * 10**9,
        payload_bytes=10**6,
        stored_bytes=10**5,
        timeline=TimelineReport(
            start_ns=T0, step_ns=10**9, counts=counts, interval_ns=20_000_000, jitter_ns=400_000
        ),
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
        if tag == "a":
            self.links += [value for key, value in attrs if key == "href" and value]
        self.loads += [str(attributes[key]) for key in ("src", "srcset", "data") if key in attributes]
        if tag not in VOID or tag == "path":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def unpacked(page: str) -> str:
    """Return a page with the content that it contains in compressed form at its end."""
    packs = re.findall(r'<script type="text/plain" id="[\w-]+">([\w+/=]+)</script>', page)
    parts = [part for text in packs for part in json.loads(zlib.decompress(base64.b64decode(text)))]
    return page + "".join(parts)
