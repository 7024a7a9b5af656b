"""Shared fixtures, such as the corpus of real recordings, and the option `--slow`."""

from __future__ import annotations

import os
import runpy
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from object_store import CREDENTIALS, ObjectStore, object_store

# Examples have no deadline, because their duration depends on the load of the machine. CI tries the same examples each time, so
# that a failure is caused by the change; other runs try new examples.
settings.register_profile("ci", deadline=None, derandomize=True)
settings.register_profile("explore", deadline=None)
settings.register_profile("long", deadline=None, max_examples=100_000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if "CI" in os.environ else "explore"))

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("MOSAICO_SHARED", ROOT.parent / "shared"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")
    parser.addoption(
        "--portable", action="store_true", help="remove the calls that only Linux, or only POSIX systems have"
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--portable"):
        folder = Path(__file__).parent / "support" / "portable"
        runpy.run_path(str(folder / "sitecustomize.py"))
        paths = [str(folder), os.environ.get("PYTHONPATH", "")]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, paths))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--slow"):
        return
    skip = pytest.mark.skip(reason="slow; run with --slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with reference material next to the checkout."""
    if not SHARED.is_dir():
        pytest.skip(f"there is no reference material (folder {SHARED.name} next to the checkout)")
    return SHARED


@pytest.fixture(scope="session")
def corpus(shared: Path) -> Path:
    """The folder of real recordings."""
    return shared / "corpus"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, also if the tests run in the background, where it is ignored by default."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def objects() -> Iterator[ObjectStore]:
    """An S3 server with an empty bucket; its credentials are in the environment."""
    pytest.importorskip("moto", reason="the S3 server of the tests is not installed")
    with pytest.MonkeyPatch.context() as patch, object_store() as running:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        yield running
