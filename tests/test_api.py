"""`RosbagInjector`, the entry point for Python programs."""

from __future__ import annotations

from pathlib import Path

from mosaico_ingest import RosbagInjector, ROSInjectionConfig
from mosaico_ingest.report.events import RunStatus

RECORDING = Path(__file__).resolve().parents[1] / "configs" / "quickstart" / "drive.mcap"


def test_injector_dry_run_reports_topics_and_writes_nothing(tmp_path: Path) -> None:
    config = ROSInjectionConfig(RECORDING, "drive", topics=["/imu"], store=tmp_path / "store", dry_run=True)
    report = RosbagInjector(config).run()
    assert report.status is RunStatus.SKIPPED
    assert report.exit_code == 0
    assert "/imu" in {topic.topic for topic in report.topics}
    assert report.totals.written == 0
    assert not (tmp_path / "store").exists()
