"""A run that rejected every message exits with 1, and never with the code 3 of a job that matches nothing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from mosaico_ingest.cli.app import main

GOOD = b"\x00\x01\x00\x00" + bytes(8)
RECORDINGS = {
    "good": ("/speed", [GOOD]),
    "rejected": ("/speed", [GOOD[:6], GOOD[:7]]),
    "other": ("/other", [GOOD]),
}
"""Topic and payloads of each recording; `other` does not have the selected topic."""
MANIFEST = """\
version: 1
bag: {{path: "{path}"}}
sequence: {{name: "drive_{{stem}}"}}
topics: [/speed]
on_error: {{message: {message}, topic: {topic}}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, with a recording of each kind in `in`."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    for name, (topic, payloads) in RECORDINGS.items():
        with Writer(tmp_path / name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(
                topic, "std_msgs/msg/Float64", msgdef="float64 data", rihs01="RIHS01_" + "0" * 64
            )
            for at, payload in enumerate(payloads):
                writer.write(connection, at, payload)
        shutil.move(next((tmp_path / name).glob("*.mcap")), tmp_path / "in" / f"{name}.mcap")
    return tmp_path


def exit_code(*arguments: str) -> int:
    with pytest.raises(SystemExit) as leave:
        main(list(arguments))
    return int(leave.value.code or 0)


def manifest(path: str, message: str = "log_warn", topic: str = "ignore") -> str:
    Path("job.yaml").write_text(MANIFEST.format(path=path, message=message, topic=topic))
    return "job.yaml"


@pytest.mark.parametrize("message", ["ignore", "log_warn"])
@pytest.mark.parametrize("topic", ["ignore", "finalize", "raise"])
@pytest.mark.usefixtures("folder")
def test_run_all_messages_rejected_exits_1(message: str, topic: str) -> None:
    assert exit_code("run", manifest("in/rejected.mcap", message, topic)) == 1


@pytest.mark.usefixtures("folder")
def test_run_no_topic_matches_exits_3() -> None:
    assert exit_code("run", manifest("in/other.mcap")) == 3


@pytest.mark.usefixtures("folder")
def test_bag_all_messages_rejected_exits_1() -> None:
    assert exit_code("bag", "in/rejected.mcap") == 1


@pytest.mark.usefixtures("folder")
def test_run_all_messages_refused_by_adapter_exits_1() -> None:
    text = Path(manifest("in/good.mcap")).read_text()
    Path("refuse.py").write_text(
        "from mosaico_ingest import ROSAdapterBase\nfrom mosaico_ingest.models import Floating64\n\n"
        "class Refuse(ROSAdapterBase[Floating64]):\n"
        "    ros_msgtype = 'std_msgs/msg/Float64'\n    __mosaico_ontology_type__ = Floating64\n\n"
        "    @classmethod\n    def from_dict(cls, ros_data):\n        raise ValueError('refused')\n"
    )
    Path("job.yaml").write_text(text + 'adapters: {load: ["refuse.py:Refuse"]}\n')
    assert exit_code("run", "job.yaml") == 1


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_batch_total_loss_of_one_recording_is_not_hidden(folder: Path, jobs: str) -> None:
    assert exit_code("run", manifest("in/*.mcap"), "--jobs", jobs) == 1
    (folder / "in" / "rejected.mcap").unlink()
    shutil.rmtree(folder / "mosaico")
    assert exit_code("run", "job.yaml", "--jobs", jobs) == 3


@pytest.mark.slow
@pytest.mark.parametrize(("name", "code"), [("rejected", 1), ("other", 3), ("good", 0)])
def test_watch_once_exits_like_a_run(folder: Path, name: str, code: int) -> None:
    (folder / "arrivals").mkdir()
    shutil.copy(folder / "in" / f"{name}.mcap", folder / "arrivals")
    assert exit_code("watch", "arrivals", manifest("unused.mcap"), "--once", "--rest", "0") == code
