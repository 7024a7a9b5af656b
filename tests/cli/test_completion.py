"""Shell completion proposes commands, sequences, topics, adapters, rules, distros and formats."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import ontology_type


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("completion")
    with StoreSink(Store.open(folder / "mosaico")).open("yard", {}) as session:
        for name in ("/imu", "/gps/fix"):
            session.topic(name, ontology_type("String"), {})
    return folder


def proposals(words: str, folder: Path) -> list[str]:
    """Return what bash would propose for the last word; it is empty after a space."""
    count = len(words.split()) - (0 if words.endswith(" ") else 1)
    environment = {
        **os.environ,
        "_INGEST_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(count),
    }
    command = [sys.executable, "-m", "mosaico_ingest"]
    finished = subprocess.run(  # noqa: S603 - our own code
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return finished.stdout.split()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("ingest store he", {"head"}),
        ("ingest store head ", {"yard/"}),
        ("ingest store head yard/", {"yard/imu", "yard/gps/fix"}),
        ("ingest store head yard/g", {"yard/gps/fix"}),
        ("ingest store describe yard/i", {"yard/imu"}),
        ("ingest store rm ", {"yard"}),
        ("ingest export ya", {"yard"}),
        ("ingest view --store mosaico ya", {"yard"}),
        ("ingest view --store nowhere ya", set()),
        ("ingest adapters show IMU", {"IMUAdapter"}),
        ("ingest lint --explain topic-n", {"topic-name"}),
        ("ingest inspect --ros-distro ros2_hu", {"ros2_humble"}),
        ("ingest lint --format sar", {"sarif"}),
    ],
)
def test_completion_proposes_names(folder: Path, words: str, expected: set[str]) -> None:
    assert set(proposals(words, folder)) == expected


@pytest.mark.slow
def test_help_lists_distros(folder: Path) -> None:
    command = [sys.executable, "-m", "mosaico_ingest", "inspect", "--help"]
    finished = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)  # noqa: S603 - our own code
    assert "ros1_noetic" in finished.stdout
