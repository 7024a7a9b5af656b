"""This file is the embedded store as a destination."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

from mosaico_ingest import wire
from mosaico_ingest.frozen import frozen
from mosaico_ingest.policies import IfExists
from mosaico_ingest.sink import Session
from mosaico_ingest.store.session import StoreSession
from mosaico_ingest.store.store import Store

__all__ = ["StoreSink"]

_BUFFER_BYTES = 96 << 20


@frozen
class StoreSink:
    """Writes sequences into a store; one session holds at most about `buffer_bytes` in memory."""

    store: Store
    buffer_bytes: int = _BUFFER_BYTES

    @contextmanager
    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        session = StoreSession(
            self.store.layout,
            self.store.catalog,
            wire.check_sequence_name(sequence),
            wire.check_metadata(metadata, where=sequence),
            if_exists=if_exists,
            buffer_bytes=self.buffer_bytes,
        )
        try:
            yield session
            session.commit()
        except BaseException:
            session.discard()
            raise
