"""The committed pages are those of the docstrings."""

from __future__ import annotations

from pathlib import Path

from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.lint.pages import write_pages

PAGES = Path(__file__).parents[2] / "docs" / "rules"


def test_the_committed_pages_are_the_current_ones(tmp_path: Path) -> None:
    write_pages(tmp_path)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        path.name: path.read_text() for path in PAGES.iterdir()
    }


def test_the_good_examples_on_the_pages_are_clean() -> None:
    assert lint_paths([PAGES], env={}).findings == ()
