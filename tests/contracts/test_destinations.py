"""Destinations that other packages add through the entry point group `mosaico_ingest.destinations`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from mosaico_ingest.api import compile_job, run
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.values import PluginTarget, ServerTarget, StoreTarget

DRIVE = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"

PAGE = Path(__file__).resolve().parents[2] / "docs" / "destinations.md"
PLUGIN = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]
"""The example of the documentation: a destination that writes one Feather file per topic."""


@pytest.fixture
def feather_plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a distribution with an entry point, as `pip install` does."""
    site = tmp_path / "site"
    info = site / "feather_plugin-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "feather_plugin.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: feather-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[mosaico_ingest.destinations]\nfeather = feather_plugin:open_feather\nbroken = feather_plugin:missing\n"
    )
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "feather_plugin", raising=False)


def manifest(folder: Path, target: str) -> Path:
    path = folder / "job.yaml"
    path.write_text(
        f"bag: {{path: {DRIVE}}}\nsequence: {{name: drive}}\ntopics: [/imu]\ntarget: {target}\n", "utf-8"
    )
    return path


@pytest.mark.usefixtures("feather_plugin")
def test_run_target_type_of_plugin_writes_with_its_sink(tmp_path: Path) -> None:
    from pyarrow import feather  # noqa: PLC0415 - only this test reads Feather files

    (report,) = run(compile_job(manifest(tmp_path, "{type: feather, options: {folder: out}}"))).recordings
    rows = feather.read_table(tmp_path / "out/drive/imu.feather")
    assert rows.column_names[0] == "timestamp_ns"
    assert rows.num_rows == sum(topic.written for topic in report.topics) > 0
    assert report.destination == "feather:out"


@pytest.mark.usefixtures("feather_plugin")
def test_destination_of_unknown_type_suggests_installed_ones() -> None:
    with pytest.raises(ManifestError) as raised:
        destination_of(PluginTarget("fether"))
    assert raised.value.where == "target.type"
    assert "feather" in (raised.value.hint or "")


@pytest.mark.usefixtures("feather_plugin")
def test_destination_of_plugin_that_fails_names_entry_point() -> None:
    with pytest.raises(Exception, match="missing") as raised:
        destination_of(PluginTarget("broken"))
    assert getattr(raised.value, "where", None) == "feather_plugin:missing"


@pytest.mark.parametrize(
    ("target", "kind", "location"),
    [
        (StoreTarget(Path("a/./b")), "store", "a/b"),
        (ServerTarget("h", 1, "secret"), "server", "h:1"),
    ],
)
def test_destination_of_builtin_target_describes_location_without_secrets(
    target: StoreTarget | ServerTarget, kind: str, location: str
) -> None:
    destination = destination_of(target)
    assert (destination.kind, destination.describe()) == (kind, location)


@pytest.mark.parametrize(
    "target",
    ["{type: lake, store: x}", "{type: lake, host: x}", "{options: {a: 1}}", "{type: lake, port: 1}"],
)
def test_manifest_target_with_conflicting_keys_is_rejected(tmp_path: Path, target: str) -> None:
    with pytest.raises(ManifestError):
        compile_job(manifest(tmp_path, target))
