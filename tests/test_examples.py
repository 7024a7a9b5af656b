"""The manifests in configs/examples: each runs as it is and stores what its first line promises."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
from object_store import BUCKET, ObjectStore

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.remote import RemotePath, as_path

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "configs" / "examples"
Tags = Mapping[str, Mapping[str, tuple[str, int]]]
"""Ontology tag and number of rows per sequence and topic."""
STORED: Mapping[str, Tags] = {
    "declarative_adapter.yaml": {"declarative_adapter": {"/battery": ("BatteryState", 10)}},
    "own_ontology.yaml": {"own_ontology": {"/battery": ("CellVoltages", 10)}},
    "python_adapter.yaml": {"python_adapter": {"/joint_states": ("WheelSpeed", 500)}},
    "override.yaml": {"override": {"/imu": ("Imu", 1000), "/lidar/points": ("Lidar", 50)}},
    "matrix.yaml": {
        "matrix_camera": {
            "/camera/camera_info": ("CameraInfo", 50),
            "/camera/image_raw": ("Image", 20),
            "/camera/image_raw/compressed": ("CompressedImage", 50),
        },
        "matrix_gps": {"/gps/fix": ("GPS", 50)},
        "matrix_imu": {"/imu": ("IMU", 1000)},
    },
    "contract.yaml": {"contract": {"/gps/fix": ("GPS", 50), "/imu": ("IMU", 1000)}},
    "split_recording.yaml": {"split_recording": {"/gps/fix": ("GPS", 50), "/imu": ("IMU", 1000)}},
}
OWN_TEST = {"quarantine.yaml", "replay.yaml", "server.yaml", "s3.yaml"}


def ingest(*arguments: str, cwd: Path, code: int = 0, environment: Mapping[str, str] | None = None) -> str:
    finished = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert finished.returncode == code, finished.stderr
    return finished.stdout


def command_of(name: str) -> list[str]:
    """Return the arguments of the command that the README states for an example."""
    rows = (EXAMPLES / "README.md").read_text().splitlines()
    (row,) = [row for row in rows if f"]({name})" in row]
    return re.findall(r"`ingest ([^`]+)`", row)[0].split()


def stored(store: Store) -> Tags:
    return {
        sequence.name: {topic.name: (topic.ontology.tag, topic.rows) for topic in sequence.topics}
        for sequence in store.sequences()
    }


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with the configs of the repository."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    return tmp_path


def test_every_example_has_a_test_and_a_row_in_the_readme() -> None:
    names = {path.name for path in EXAMPLES.glob("*.yaml")}
    assert names == STORED.keys() | OWN_TEST
    readme = (EXAMPLES / "README.md").read_text()
    assert names <= set(re.findall(r"\]\(([\w.]+)\)", readme))


def test_every_link_in_the_readme_leads_to_a_file() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", (EXAMPLES / "README.md").read_text()):
        assert (EXAMPLES / target).exists(), target


@pytest.mark.parametrize("name", STORED)
def test_example_run_stores_typed_topics(project: Path, name: str) -> None:
    ingest(*command_of(name), cwd=project)
    assert stored(Store.open(project / "mosaico")) == STORED[name]


def test_quarantine_example_rejects_one_message_and_replay_adds_it(project: Path) -> None:
    ingest(*command_of("quarantine.yaml"), cwd=project, code=4)
    store = Store.open(project / "mosaico")
    assert stored(store) == {"quarantine": {"/battery": ("ChargeLevel", 9)}}
    comment = (EXAMPLES / "quarantine.yaml").read_text()
    command = re.findall(r"# Then run: ingest (.*)", comment)[0]
    assert command.split() == command_of("replay.yaml")
    ingest(*command_of("replay.yaml"), cwd=project)
    assert stored(store) == {"quarantine": {"/battery": ("ChargeLevel", 10)}}


def test_contract_example_refuses_a_recording_that_violates_it(project: Path) -> None:
    contract = project / "configs/examples/fleet/expect.yaml"
    contract.write_text(contract.read_text().replace("max: 50 ms", "max: 5 ms"))
    ingest("check", "configs/examples/contract.yaml", cwd=project, code=6)
    ingest("configs/examples/contract.yaml", cwd=project, code=6)
    assert not any((project / "mosaico").glob("segments/*"))


@contextmanager
def served(store: Path, port: int) -> Iterator[None]:
    command = [sys.executable, "-m", "mosaico_ingest", "serve", "--store", str(store), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:  # noqa: S603 - our own command
        assert server.stdout is not None
        server.stdout.readline()
        try:
            yield
        finally:
            server.send_signal(signal.SIGTERM)


def test_server_example_uploads_to_a_served_store(project: Path) -> None:
    manifest = project / "configs/examples/server.yaml"
    text = manifest.read_text()
    assert "port: 6726" in text
    manifest.write_text(text.replace("6726", "6759"))  # a developer may serve a store on the default port
    with served(project / "served", 6759):
        ingest(*command_of("server.yaml"), cwd=project)
    assert stored(Store.open(project / "served")) == {
        "server": {"/gps/fix": ("GPS", 50), "/imu": ("IMU", 1000)}
    }


@pytest.mark.slow
def test_s3_example_reads_and_writes_behind_urls(project: Path, objects: ObjectStore) -> None:
    recording = as_path(objects.url("recordings/drive.mcap"))
    assert isinstance(recording, RemotePath)
    recording.write_bytes((ROOT / "configs/quickstart/drive.mcap").read_bytes())
    options = objects.url("").partition("?")[2]
    environment = {**os.environ, "BUCKET": BUCKET, "S3_OPTIONS": f"?{options}"}
    ingest(*command_of("s3.yaml"), cwd=project, environment=environment)
    names = ingest("store", "ls", "--json", "--store", objects.url("store"), cwd=project)
    assert '"s3_drive"' in names


@pytest.mark.slow
def test_adapters_of_the_examples_pass_their_tests(project: Path) -> None:
    adapters = sorted(str(path) for path in (project / "configs/examples/adapters").glob("*.yaml"))
    definitions = str(project / "configs/quickstart/acme_msgs")
    ingest("adapters", "test", *adapters, "--msg-dir", f"acme_msgs={definitions}", cwd=project)


def test_split_example_recording_equals_the_output_of_its_script(tmp_path: Path) -> None:
    script = EXAMPLES / "split" / "make_split.py"
    subprocess.run([sys.executable, str(script), str(tmp_path)], check=True, timeout=60)  # noqa: S603 - our own script
    for number in (0, 1):
        name = f"drive_{number}.mcap"
        assert (tmp_path / name).stat().st_size == (EXAMPLES / "split" / name).stat().st_size
