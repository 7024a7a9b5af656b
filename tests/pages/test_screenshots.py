"""The pictures of the documentation can be taken again, and are small."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import CHROMIUM
from PIL import Image
from screenshots import IMAGES, NAMES, WIDTH, take_screenshots

MAX_BYTES = 200_000
MIN_COLORS = 20
"""A blank picture has fewer colors."""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_screenshots_are_taken_of_each_page(tmp_path: Path) -> None:
    take_screenshots(tmp_path)
    for name in NAMES:
        check(tmp_path / name)


@pytest.mark.parametrize("name", NAMES)
def test_picture_of_the_documentation_is_small_and_shows_a_page(name: str) -> None:
    check(IMAGES / name)


def check(path: Path) -> None:
    assert path.stat().st_size < MAX_BYTES
    with Image.open(path) as picture:
        assert picture.width == WIDTH
        assert len(picture.convert("RGB").getcolors(1 << 24) or ()) > MIN_COLORS
