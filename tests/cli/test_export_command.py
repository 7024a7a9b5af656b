"""`ingest export`."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.server.client import server_at
from mosaico_ingest.errors import SinkError
from mosaico_ingest.protocol.messages import Permission
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.recording import open_recording
from mosaico_ingest.serve import Keyring, serve

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


def ingest(folder: Path, *arguments: str) -> Done:
    """Run the command in a folder, in this process."""
    out, err = io.StringIO(), io.StringIO()
    before = Path.cwd()
    os.chdir(folder)
    try:
        with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as left:
            main(arguments)
    finally:
        os.chdir(before)
    return Done(int(left.value.code or 0), out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store that holds the sequence `drive`."""
    folder = tmp_path_factory.mktemp("export")
    result = ingest(folder, "bag", str(DRIVE), "--name", "drive", "--quiet")
    assert result.returncode == 0, result.stderr
    return folder


def test_export_prints_every_topic_and_file(folder: Path) -> None:
    result = ingest(folder, "export", "drive", "--to", "a.mcap")
    assert result.returncode == 0, result.stderr
    assert "FrameTransformAdapter" in result.stdout
    assert "a.mcap: 2,130 messages" in result.stdout


def test_export_with_json_prints_report(folder: Path) -> None:
    result = ingest(
        folder, "export", "drive", "--to", "b.mcap", "-t", "/imu", "--start", "+2s", "--end", "-3s", "--json"
    )
    account = json.loads(result.stdout)
    assert [topic["topic"] for topic in account["topics"]] == ["/imu"]
    assert account["topics"][0]["messages"] == 499


def test_export_to_standard_output_writes_recording(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mosaico_ingest", "export", "drive", "--to", "-", "--topics", "/imu"]
    finished = subprocess.run(command, cwd=folder, capture_output=True, check=True, timeout=60)  # noqa: S603 - our own
    path = tmp_path / "piped.mcap"
    path.write_bytes(finished.stdout)
    with open_recording(path, resolve=TypeResolver()) as recording:
        assert {one.topic: one.count for one in recording.connections} == {"/imu": 1000}
    assert b"/imu" in finished.stderr


def test_export_excluded_topic_exits_4(folder: Path) -> None:
    job = DRIVE.parents[1] / "quickstart.yaml"
    (folder / "quickstart").symlink_to(DRIVE.parent)
    (folder / "job.yaml").write_text(job.read_text().replace("../mosaico", "mosaico"))
    assert ingest(folder, "run", "job.yaml", "--quiet").returncode == 0
    result = ingest(folder, "export", "quickstart_drive", "--to", "c.mcap")
    assert result.returncode == 4
    assert "/battery: excluded: no known adapter converts acme_msgs/msg/BatteryPack" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("drive", "--to", "x.txt"), 1, "use one of .bag, .db3 and .mcap"),
        (("drive", "--to", "x.bag"), 3, "is a ROS 2 type"),
        (("drive", "--to", "x.mcap", "-t", "/none"), 3, "no topic matches"),
        (("nobody", "--to", "x.mcap"), 1, "no sequence 'nobody'"),
        (("drive", "--to", "x.mcap", "--start", "soon"), 2, "neither an instant"),
        (("drive", "--to", "x.mcap", "--adapter", "Nonsense"), 1, "there is no adapter 'Nonsense'"),
    ],
)
def test_export_invalid_arguments_leave_no_file(
    folder: Path, arguments: tuple[str, ...], code: int, says: str
) -> None:
    result = ingest(folder, "export", *arguments)
    assert result.returncode == code
    assert says in result.stderr
    assert not list(folder.glob("x.*"))


@pytest.fixture
def secured(tmp_path: Path) -> Iterator[tuple[str, Keyring]]:
    """The address of a server that requires a key, and its keys; it has the sequence `drive`."""
    ring = Keyring(tmp_path / "keys.json")
    with serve(tmp_path / "served", port=0, keys=ring) as server:
        address = f"127.0.0.1:{server.port}"
        key = ring.add(Permission.WRITE)
        host, port = address.split(":")
        upload = ("bag", str(DRIVE), "--name", "drive", "--host", host, "--port", port, "--api-key", key)
        assert ingest(tmp_path, *upload).returncode == 0
        yield address, ring


def test_export_from_server_writes_the_selected_part(secured: tuple[str, Keyring], tmp_path: Path) -> None:
    address, ring = secured
    options = (
        "--topics",
        "/imu",
        "--start",
        "+2s",
        "--end=-5s",
        "--api-key",
        ring.add(Permission.READ),
        "--json",
    )
    result = ingest(
        tmp_path, "export", "drive", "--from", f"mosaico://{address}", "--to", "imu.mcap", *options
    )
    assert result.returncode == 0, result.stderr
    (topic,) = json.loads(result.stdout)["topics"]
    assert (topic["topic"], topic["messages"]) == ("/imu", 299)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ((), 1, "requires an API key"),
        (("--api-key", "msco_wrong"), 1, "API key is refused"),
        (("--store", "mosaico"), 2, "excludes --from"),
    ],
)
def test_export_from_server_refused_option_leaves_no_file(
    secured: tuple[str, Keyring], tmp_path: Path, options: tuple[str, ...], code: int, words: str
) -> None:
    result = ingest(tmp_path, "export", "drive", "--from", secured[0], "--to", "out.mcap", *options)
    assert result.returncode == code
    assert words in result.stderr
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("robot", ("robot", 6726, False)),
        ("robot:7", ("robot", 7, False)),
        ("mosaico://robot:7/", ("robot", 7, False)),
        ("mosaico+tls://robot", ("robot", 6726, True)),
        ("grpc+tls://[::1]:7", ("::1", 7, True)),
    ],
)
def test_server_at_address_is_parsed(text: str, target: tuple[str, int, bool]) -> None:
    server = server_at(text)
    assert (server.host, server.port, server.tls) == target


@pytest.mark.parametrize("text", ["", "http://robot", "robot:70000", "robot:port", "robot/s", "::1"])
def test_server_at_other_text_raises(text: str) -> None:
    with pytest.raises(SinkError, match="not the address of a server"):
        server_at(text)
