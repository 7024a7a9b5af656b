"""Every promise of the reference has a test, and the page that lists them is current."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parent


@pytest.fixture(scope="module")
def promises() -> ModuleType:
    spec = importlib.util.spec_from_file_location("promises", FOLDER / "promises.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["promises"] = module
    spec.loader.exec_module(module)
    return module


def test_every_promise_has_a_test_and_every_marker_a_promise(promises: ModuleType) -> None:
    listed = [name for section in promises.PROMISES.values() for name in section]
    assert len(listed) == len(set(listed))
    assert set(promises.coverage()) == set(listed)


def test_promise_without_test_is_noticed(promises: ModuleType, tmp_path: Path) -> None:
    assert promises.coverage(tmp_path) == {}


def test_coverage_page_is_current(promises: ModuleType) -> None:
    path = promises.ROOT / "docs" / "reference-coverage.md"
    assert path.read_text(encoding="utf-8") == promises.page(), "run ./dev docs"
