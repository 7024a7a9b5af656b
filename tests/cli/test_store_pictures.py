"""`ingest store plot` and `image`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from typer.testing import CliRunner

from mosaico_ingest import api
from mosaico_ingest.cli.app import command_line

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
CAMERA = "quickstart_drive/camera/image_raw/compressed"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("pictures") / "store"
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    api.run([job.replace(target=job.target.replace(store=str(folder)))])
    return str(folder)


@pytest.fixture
def output(store: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return the function that runs a command of `ingest store` in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str, code: int = 0) -> str:
        result = CliRunner().invoke(command_line(["store"]), ["store", *words, "--store", store])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            assert code == 1
            return str(result.exception)
        assert result.exit_code == code, result.output
        return result.output

    return run


def test_image_writes_picture_of_nearest_row(output: Callable[..., str]) -> None:
    text = output("image", CAMERA, "--at", "+2s", "--out", "x.png")
    assert text == "wrote x.png: 64 x 48 pixels, rgb8; png compressed, 2026-01-01 00:00:02.000056\n"
    first, later = map(pixels, (_first(output), Path("x.png")))
    assert first.shape == later.shape == (48, 64, 3)
    assert (first != later).any()
    assert later[0, 0].tolist() == pytest.approx([0, 0, 90], abs=2)  # the top left corner is dark blue


def pixels(path: Path) -> npt.NDArray[np.uint8]:
    with Image.open(path) as picture:
        return np.asarray(picture)


def _first(output: Callable[..., str]) -> Path:
    output("image", CAMERA)
    return Path("camera-image_raw-compressed.png")


def test_image_contact_sheet_has_a_picture_per_time(output: Callable[..., str]) -> None:
    assert "4 pictures" in output("image", CAMERA, "--contact-sheet", "-n", "4", "-o", "x.webp")
    assert pixels(Path("x.webp")).shape == (48 + 24 + 4, 4 * 68 + 4, 3)


def test_image_of_point_cloud_is_drawn_from_above(output: Callable[..., str]) -> None:
    output("image", "quickstart_drive/lidar/points", "-o", "x.png", "--size", "300")
    assert max(pixels(Path("x.png")).shape) == 300


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["image", "quickstart_drive/imu"], "rows of IMU are no pictures"),
        (["image", CAMERA, "--out", "x.txt"], ".txt is no supported suffix"),
        (["image", "quickstart_drive/imu", "--contact-sheet"], "rows of IMU are no pictures"),
        (["plot", "quickstart_drive/imu", "acceleration.q"], "the field 'acceleration.q' does not exist"),
        (["plot", "quickstart_drive/imu", "--out", "x.txt"], ".txt is no supported suffix"),
        (["plot", "quickstart_drive/tf"], "rows of FrameTransform contain no numbers to plot"),
    ],
)
def test_pictures_impossible_request_states_problem(
    output: Callable[..., str], words: list[str], problem: str
) -> None:
    assert problem in output(*words, code=1)


def test_plot_prints_chart_per_unit_with_bounds(output: Callable[..., str]) -> None:
    lines = output("plot", "quickstart_drive/imu", "acceleration.x", "angular_velocity.z").splitlines()
    assert lines[0] == "quickstart_drive/imu in m/s²"
    assert lines[1] == "━ acceleration.x  -0.0571434 .. 0.0726586"
    assert "quickstart_drive/imu in rad/s" in lines
    assert sum("┤" in line for line in lines) == 32
    assert lines[-1].split() == ["2026-01-01", "00:00:00.000", "+9.99", "s"]


def test_plot_writes_file_and_reads_time_range(output: Callable[..., str]) -> None:
    output("plot", "quickstart_drive/imu", "--out", "x.svg")
    assert "acceleration.x" in Path("x.svg").read_text() or Path("x.svg").stat().st_size > 10_000
    assert "+0.49 s" in output("plot", "quickstart_drive/imu", "--from", "+1s", "--until", "+1.5s")
    assert "no rows here" in output("plot", "quickstart_drive/imu", "--from", "+1h")


def test_plot_without_matplotlib_names_the_extra(
    output: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert "mosaico-ingest[plot]" in output("plot", "quickstart_drive/imu", "--out", "x.png", code=1)


def test_image_without_pillow_names_the_extra(
    output: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    assert "mosaico-ingest[images]" in output("image", CAMERA, code=1)
