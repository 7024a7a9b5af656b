"""docs/reliability.md names existing tests."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"(?:tests/[\w/]*|\b)test_\w+\.py|tests/[\w/]+", DOCUMENT)))


@pytest.mark.parametrize("name", NAMED)
def test_document_names_existing_tests(name: str) -> None:
    assert (ROOT / name).exists() or (Path(__file__).parent / name).exists()


def test_document_names_every_reliability_test_file() -> None:
    own = {path.name for path in Path(__file__).parent.glob("test_*.py")} - {Path(__file__).name}
    assert own <= {Path(name).name for name in NAMED}
