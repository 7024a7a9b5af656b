"""Named patterns of file names."""

from __future__ import annotations

import pickle
from datetime import date

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.job.values import FileNamePattern

TEXTS = st.text("abcXYZ019-", min_size=1, max_size=8)


@pytest.mark.parametrize(
    ("pattern", "name", "values"),
    [
        (
            "{vehicle}_{date:%Y%m%d}_{run:int}.mcap",
            "r1_20260301_007.mcap",
            {"vehicle": "r1", "date": "2026-03-01", "run": 7},
        ),
        (
            "{vehicle}_{date:%Y%m%d}_{run:int}.mcap",
            "r_1_b_20260301_7.mcap",
            {"vehicle": "r_1_b", "date": "2026-03-01", "run": 7},
        ),
        ("{v}.mcap", "a.b.mcap", {"v": "a.b"}),
        ("{v}.mcap", "a.bag", None),
        ("{v}.mcap", "x/a.mcap", None),
        ("{run:int}.bag", "x.bag", None),
        ("{run:int}.bag", "-1.bag", None),
        ("{speed:float}kmh.bag", "12.5kmh.bag", {"speed": 12.5}),
        ("{start:%Y-%m-%dT%H%M%S}.db3", "2026-03-01T123000.db3", {"start": "2026-03-01T12:30:00"}),
        ("{start:%H%M}.db3", "1230.db3", {"start": "12:30:00"}),
        ("{day:%Y%m%d}.db3", "20261301.db3", None),
        ("{_}_{v}.db3", "skip_this.db3", {"v": "this"}),
        ("{site}/{day:%Y%m%d}/{v}.db3", "lab/20260301/a.db3", {"site": "lab", "day": "2026-03-01", "v": "a"}),
        ("{{{v}}}.db3", "{a}.db3", {"v": "a"}),
        ("a+b_{v}.db3", "a+b_c.db3", {"v": "c"}),
    ],
)
def test_match_returns_values_of_fields(pattern: str, name: str, values: dict[str, object] | None) -> None:
    assert FileNamePattern(pattern).match(name) == values


@pytest.mark.parametrize(
    "pattern",
    ["run.mcap", "{}.mcap", "{a b}.mcap", "{a}_{a}.mcap", "{a:word}.mcap", "{a:%Q}.mcap", "{a}}.mcap", "{_}"],
)
def test_pattern_with_mistake_raises_value_error(pattern: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        FileNamePattern(pattern)


def test_pattern_with_misspelled_kind_suggests_kind() -> None:
    with pytest.raises(ValueError, match="did you mean 'int'"):
        FileNamePattern("{run:itn}.mcap")


@given(TEXTS, st.dates(min_value=date(1000, 1, 1)), st.integers(0, 10**6))
def test_match_of_formatted_name_returns_its_values(vehicle: str, day: date, run: int) -> None:
    name = f"{vehicle}_{day:%Y%m%d}_{run}.mcap"
    expected = {"vehicle": vehicle, "date": day.isoformat(), "run": run}
    assert FileNamePattern("{vehicle}_{date:%Y%m%d}_{run:int}.mcap").match(name) == expected


def test_pattern_survives_pickle() -> None:
    pattern = FileNamePattern("{a}_{b:int}")
    pattern.match("x_1")
    assert pickle.loads(pickle.dumps(pattern)) == pattern  # noqa: S301 - pickled above
