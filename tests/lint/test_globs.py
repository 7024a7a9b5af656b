"""`covers` compares two globs without topics and never claims too much."""

from __future__ import annotations

from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.lint.check import covers

PATTERNS = st.text(alphabet="/ab*?", max_size=6)
NAMES = st.text(alphabet="/ab", max_size=8)


@pytest.mark.parametrize(
    ("general", "special", "expected"),
    [
        ("*", "/a", True),
        ("/a/*", "/a/b/*", True),
        ("/a/*", "/a/b", True),
        ("/a?", "/a*", False),
        ("/a/b", "/a/*", False),
        ("/*/image", "/front/image", True),
        ("/a*", "/a", True),
        ("/a/[bc]", "/a/b", True),
    ],
)
def test_covers_decides_known_pairs(general: str, special: str, expected: bool) -> None:  # noqa: FBT001 - a parameter of the test
    assert covers(general, special) is expected


@given(PATTERNS, PATTERNS, NAMES)
def test_covering_glob_matches_every_name_of_covered_glob(general: str, special: str, name: str) -> None:
    if covers(general, special) and fnmatchcase(name, special):
        assert fnmatchcase(name, general)
