"""Contracts of runs that store sequences on a server or in an object store."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from object_store import ObjectStore

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.remote import AnyPath, as_path
from mosaico_ingest.serve import serve

DRIVE = Path(__file__).parents[2] / "configs" / "quickstart" / "drive.mcap"
JOB = """\
bag: {{path: drive.mcap}}
sequence: {{name: drive, if_exists: replace}}
target: {target}
topics: [/imu]
expect: {{on_failure: {action}, topics: {{/imu: {{rate: {{min: {rate}}}, fields: {{acceleration.z: {{finite: true}}}}}}}}}}
"""


def run(folder: Path, target: str, rate: str, action: str = "fail") -> tuple[int, bool | None]:
    """Return the exit code and whether the contract holds."""
    shutil.copy(DRIVE, folder)
    path = folder / "job.yaml"
    path.write_text(JOB.format(target=target, rate=rate, action=action))
    (report,) = api.run(api.compile_job(path)).recordings
    return report.exit_code, None if report.contract is None else report.contract.passed


def check_actions(folder: Path, target: str, location: AnyPath) -> None:
    """Check the content of a store after runs whose contract fails, is diverted, and holds."""

    def names() -> tuple[str, ...]:
        store = Store.find(location)
        return () if store is None else store.names()

    assert run(folder, target, "150 Hz") == (6, False)
    assert names() == ()
    assert run(folder, target, "150 Hz", "divert") == (6, False)
    assert names() == ("drive__failed",)
    assert run(folder, target, "95 Hz") == (0, True)
    assert names() == ("drive", "drive__failed")
    contract = Store.open(location).sequence("drive").metadata["mosaico_ingest"]["contract"]
    assert (contract["passed"], contract["expectations"]) == (True, 2)


def test_contract_of_run_to_a_server_decides_about_its_content(tmp_path: Path) -> None:
    with serve(tmp_path / "served", port=0) as server:
        target = f"{{host: 127.0.0.1, port: {server.port}}}"
        check_actions(tmp_path, target, tmp_path / "served")


@pytest.mark.slow
def test_contract_of_run_to_an_object_store_decides_about_its_content(
    objects: ObjectStore, tmp_path: Path
) -> None:
    url = objects.url(f"contracts/{tmp_path.name}")
    check_actions(tmp_path, f'{{store: "{url}"}}', as_path(url))
