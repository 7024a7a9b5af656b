"""`on_error.message: log_warn` logs undecodable messages in groups; `ignore` only counts them."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from mosaico_ingest import LoaderErrorPolicy, RosbagInjector, ROSInjectionConfig
from mosaico_ingest.cli.app import main
from mosaico_ingest.findings import Stage
from mosaico_ingest.pipeline.rejections import RejectionLog
from mosaico_ingest.report.events import Rejected, RunFinished, RunStatus

GOOD = b"\x00\x01\x00\x00" + bytes(8)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording with one good message and two truncated ones."""
    folder = tmp_path / "drive"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            "/speed", "std_msgs/msg/Float64", msgdef="float64 data", rihs01="RIHS01_" + "0" * 64
        )
        for number, payload in enumerate((GOOD, GOOD[:6], GOOD[:7])):
            writer.write(connection, number, payload)
    return folder


def rejected(count: int, stage: Stage = Stage.DECODE) -> Rejected:
    return Rejected("/speed", stage, "cdr-length", count, "too short", 10**9, 77)


def run(recording: Path, tmp_path: Path, **options: object) -> None:
    store = tmp_path / "store"
    report = RosbagInjector(ROSInjectionConfig(recording, "drive", store=store, **options)).run()
    assert (report.totals.written, report.totals.rejected) == (1, 2)


@pytest.mark.promise("corrupt-messages", "loader-log-warn")
def test_injector_log_warn_logs_undecodable_messages(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    run(recording, tmp_path)
    (record,) = [record for record in caplog.records if record.name == "mosaico_ingest.pipeline"]
    assert record.levelno == logging.WARNING
    text = record.getMessage()
    assert text.startswith("drive: 2 messages cannot be decoded [")
    assert "topic /speed, first log time 1970-01-01 00:00:00.000, offset " in text


@pytest.mark.promise("loader-ignore")
def test_injector_ignore_logs_nothing(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run(recording, tmp_path, manifest={"on_error": {"message": LoaderErrorPolicy.IGNORE}})
    assert caplog.records == []


@pytest.mark.promise("log-level")
def test_injector_log_level_error_suppresses_warnings_during_run_only(
    recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    logger = logging.getLogger("mosaico_ingest")
    level = logger.level
    run(recording, tmp_path, log_level="ERROR")
    assert caplog.records == []
    assert logger.level == level


@pytest.mark.parametrize(
    ("options", "logged"), [((), True), (("--log", "error"), False), (("--quiet",), False)]
)
def test_bag_command_undecodable_messages_are_logged(
    recording: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    logged: bool,  # noqa: FBT001 - a parameter
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as exited:
        main(["bag", str(recording), "--store", str(tmp_path / "store"), *options])
    assert exited.value.code == 4
    assert ("WARNING mosaico_ingest.pipeline: drive: 2 messages" in capsys.readouterr().err) == logged


def test_rejection_log_many_messages_logs_first_and_rest(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    log = RejectionLog("drive")
    for event in (rejected(1), rejected(2), rejected(3), rejected(5, Stage.ADAPT)):
        log(event)
    log(RunFinished(RunStatus.WITH_ERRORS, 4))
    log(RunFinished(RunStatus.WITH_ERRORS, 4))
    assert [record.getMessage().partition(" cannot")[0] for record in caplog.records] == [
        "drive: 1 message",
        "drive: 5 more messages",
    ]
