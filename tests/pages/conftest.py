"""Fixtures of the tests of pages: a store with the quickstart and a hostile sequence, and a browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from browser import CHROMIUM, Browser, open_browser
from stored_sequences import store_quickstart, write_hostile

from mosaico_ingest.destinations.store import Store


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store with the sequences `quickstart_drive` and `hostile`."""
    filled = store_quickstart(tmp_path_factory.mktemp("pages") / "store")
    write_hostile(filled)
    return filled


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A tab of Chromium."""
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with open_browser() as running:
        yield running
