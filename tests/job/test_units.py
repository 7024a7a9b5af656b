"""Parsing of sizes, offsets and instants."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.job.values import parse_instant, parse_offset, parse_size


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1B", 1),
        ("512MiB", 512 * 2**20),
        ("2 GB", 2 * 10**9),
        ("1.5kB", 1500),
        ("1KB", 1000),
        ("1TiB", 2**40),
    ],
)
def test_parse_size_valid_text_returns_bytes(text: str, expected: int) -> None:
    assert parse_size(text) == expected


@pytest.mark.parametrize("text", ["", "12", "MiB", "1 cow", "-1B", "1mB", "1e3B"])
def test_parse_size_invalid_text_raises(text: str) -> None:
    with pytest.raises(ValueError, match="size"):
        parse_size(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("+10s", 10**10),
        ("-1.5min", -90 * 10**9),
        ("+1ns", 1),
        ("+0.123456789s", 123456789),
        ("-2h", -7200 * 10**9),
    ],
)
def test_parse_offset_valid_text_returns_nanoseconds(text: str, expected: int) -> None:
    assert parse_offset(text) == expected


@pytest.mark.parametrize("text", ["10s", "+10", "+s", "+10m", "+-1s"])
def test_parse_offset_invalid_text_raises(text: str) -> None:
    with pytest.raises(ValueError, match="offset"):
        parse_offset(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1970-01-01", 0),
        ("1970-01-01T00:00:01Z", 10**9),
        ("1970-01-01 00:00:01.5", 1_500_000_000),
        ("1970-01-01T01:00+01:00", 0),
        ("2026-03-01T12:00:00.123456789Z", 1772366400123456789),
    ],
)
def test_parse_instant_valid_text_returns_nanoseconds_since_epoch(text: str, expected: int) -> None:
    assert parse_instant(text) == expected


@pytest.mark.parametrize("text", ["now", "2026-13-01", "2026-03-01T25:00", "12:00", ""])
def test_parse_instant_invalid_text_raises(text: str) -> None:
    with pytest.raises(ValueError, match=r"instant|month|hour"):
        parse_instant(text)


@pytest.mark.parametrize("parse", [parse_size, parse_offset, parse_instant])
@given(text=st.text(max_size=30))
def test_parse_any_text_returns_integer_or_raises(parse: Callable[[str], int], text: str) -> None:
    with suppress(ValueError):
        assert isinstance(parse(text), int)
