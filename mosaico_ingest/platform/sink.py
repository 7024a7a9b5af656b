"""This file is a Mosaico server as a destination."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

from mosaico_ingest import wire
from mosaico_ingest.config import ServerTarget
from mosaico_ingest.errors import IngestError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.platform.client import connect
from mosaico_ingest.platform.faults import add_hint
from mosaico_ingest.platform.session import PlatformSession
from mosaico_ingest.policies import IfExists
from mosaico_ingest.sink import Session

__all__ = ["PlatformSink"]

_BUFFER_BYTES = 96 << 20


@frozen
class PlatformSink:
    """Writes sequences to a server; one session holds at most about `buffer_bytes` in memory.

    A server has no way to swap sequences, so `replace` deletes the old one when the session is opened; and it
    adds no rows to a topic that is there, so `append` takes new topics only.
    """

    target: ServerTarget
    buffer_bytes: int = _BUFFER_BYTES

    @contextmanager
    def open(
        self, sequence: str, metadata: Mapping[str, Any], *, if_exists: IfExists = IfExists.FAIL
    ) -> Generator[Session, None, None]:
        """Open a session; see `Sink.open`."""
        wire.check_sequence_name(sequence)
        described = wire.check_metadata(metadata, where=sequence)
        with connect(self.target) as client:
            session = PlatformSession(
                self.target, client, sequence, described, if_exists=if_exists, buffer_bytes=self.buffer_bytes
            )
            try:
                yield session
                session.commit()
            except BaseException as error:
                left = session.discard()
                if left and isinstance(error, IngestError):
                    add_hint(error, left)
                raise
