"""This file keeps the catalogs of stores open from one recording to the next."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from mosaico_ingest.destinations.store.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.job.values import ServerTarget, StoreTarget

__all__ = ["Hold", "held_catalogs"]

Hold = Callable[[StoreTarget | ServerTarget], None]


@contextmanager
def held_catalogs() -> Generator[Hold]:
    """Yield what keeps the catalog of a store open: closing one for the last time costs a checkpoint a recording."""
    known: set[Path] = set()
    with ExitStack() as open_ones:

        def hold(target: StoreTarget | ServerTarget) -> None:
            path = target.path if isinstance(target, StoreTarget) else None
            if not isinstance(path, Path) or path in known:
                return
            with suppress(SinkError):  # opening the store for the run says what is wrong
                store = Store.find(path)
                if store is not None:
                    open_ones.enter_context(closing(store.catalog.keep_open()))
                    known.add(path)

        yield hold
