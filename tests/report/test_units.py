"""Numbers and lists as text."""

from __future__ import annotations

import pytest

from mosaico_ingest.display import counted
from mosaico_ingest.findings import join_names


@pytest.mark.parametrize(("count", "text"), [(0, "0 rows"), (1, "1 row"), (12_345, "12,345 rows")])
def test_counted_one_is_singular(count: int, text: str) -> None:
    assert counted(count, "row") == text


def test_a_few_states_number_of_omitted_names() -> None:
    assert join_names(["b", "a"]) == "a, b"
    assert join_names("hgfedcba") == "a, b, c, d, e, f, g, h"
    assert join_names([f"/t{n:04}" for n in range(1500)], most=2) == "/t0000, /t0001 and 1,498 more"
