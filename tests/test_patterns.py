"""Topic patterns: selection, exclusion and precedence as in the reference."""

from __future__ import annotations

from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.job.values import first_match, select

TOPICS = ("/imu", "/tf", "/cam/left", "/cam/right", "/cam/debug/left")


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        ([], TOPICS),
        (["/cam*"], ("/cam/left", "/cam/right", "/cam/debug/left")),
        (["/cam*", "!/cam/debug*"], ("/cam/left", "/cam/right")),
        (["!/cam*"], ("/imu", "/tf")),
        (["/imu", "!*", "/tf"], ("/tf",)),
        (["!/tf", "/imu"], ("/imu",)),
        (["cam"], ()),
        (["/IMU"], ()),
        (["/cam/?eft"], ("/cam/left",)),
        (["/cam/[lr]*"], ("/cam/left", "/cam/right")),
    ],
)
def test_select_applies_patterns_in_order(patterns: list[str], expected: tuple[str, ...]) -> None:
    assert select(patterns, TOPICS).selected == expected


def test_select_returns_the_deciding_pattern_of_each_topic() -> None:
    decided = select(["/cam*", "!/cam/debug*"], TOPICS).decided_by
    assert decided == {"/imu": None, "/tf": None, "/cam/left": 0, "/cam/right": 0, "/cam/debug/left": 1}


def test_select_returns_patterns_without_a_match() -> None:
    assert select(["/imu", "/lidar/*"], TOPICS).unused == (1,)


@given(st.lists(st.sampled_from(["/imu", "/cam*", "!*", "!/cam*", "/tf", "!/tf", "*"])))
def test_select_last_matching_pattern_decides(patterns: list[str]) -> None:
    for topic in TOPICS:
        matching = [p for p in patterns if fnmatchcase(topic, p.removeprefix("!"))]
        default = all(p.startswith("!") for p in patterns)
        expected = not matching[-1].startswith("!") if matching else default
        assert (topic in select(patterns, TOPICS).selected) == expected


def test_first_match_prefers_exact_name_to_globs() -> None:
    assert first_match(["/cam*", "/cam/left"], "/cam/left") == "/cam/left"
    assert first_match(["/cam*", "*"], "/cam/right") == "/cam*"
    assert first_match(["/cam*"], "/imu") is None
