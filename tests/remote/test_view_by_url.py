"""Commands that show rows, pictures and queries print the same for a store behind a URL and on a disk."""

from __future__ import annotations

from pathlib import Path

import pytest
from object_store import ObjectStore
from typer.testing import CliRunner

from mosaico_ingest import api
from mosaico_ingest.cli.app import command_line

pytestmark = pytest.mark.slow

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


@pytest.fixture(scope="module")
def stores(objects: ObjectStore, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """The quickstart in a folder and behind a URL."""
    folder = str(tmp_path_factory.mktemp("view") / "store")
    url = objects.url("stores/view")
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    api.run([job.replace(target=job.target.replace(store=store)) for store in (folder, url)])
    return folder, url


@pytest.mark.parametrize(
    "words",
    [
        ["head", "quickstart_drive/imu", "--at", "+2s"],
        ["tail", "quickstart_drive/odom", "-n", "3", "--json"],
        ["sample", "quickstart_drive/gps/fix", "--csv"],
        ["describe", "quickstart_drive"],
        ["describe", "quickstart_drive/joint_states"],
        ["plot", "quickstart_drive/imu", "acceleration"],
        ["image", "quickstart_drive/camera/image_raw/compressed", "--at", "+2s", "--out", "x.png"],
        ["image", "quickstart_drive/lidar/points", "--contact-sheet", "--out", "x.png"],
        ["sql"],
        ["sql", "SELECT avg(acceleration.z), count(*) FROM quickstart_drive.imu", "--json"],
        ["sql", "SELECT timestamp_ns, position FROM quickstart_drive.gps_fix ORDER BY 1", "--csv"],
    ],
)
def test_view_command_prints_the_same_behind_url(
    stores: tuple[str, str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outputs: list[tuple[str, bytes]] = []
    for store in stores:
        result = CliRunner().invoke(command_line(["store"]), ["store", *words, "--store", store])
        if result.exception is not None:
            raise result.exception
        picture = Path("x.png")
        outputs.append((result.output, picture.read_bytes() if picture.exists() else b""))
    assert outputs[0] == outputs[1]
