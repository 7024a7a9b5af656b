"""This file is the Flight service: it checks the permission of each call and hands it on."""

from __future__ import annotations

from collections.abc import Generator, Iterator

import pyarrow as pa
import pyarrow.flight as fl

from mosaico_ingest.store.server.access import MIDDLEWARE, KeyCheck, require
from mosaico_ingest.store.server.answers import ANSWERS, Backend
from mosaico_ingest.store.server.flights import Flights
from mosaico_ingest.store.server.keyring import Keyring
from mosaico_ingest.store.server.refusals import Refusal, answered
from mosaico_ingest.store.server.uploads import Uploads
from mosaico_ingest.store.store import Store
from mosaico_ingest.wire import bodies
from mosaico_ingest.wire.actions import ACTIONS, Permission
from mosaico_ingest.wire.codec import JSON
from mosaico_ingest.wire.conditions import Condition

__all__ = ["Service"]


class Service(fl.FlightServerBase):
    """Serves one store; Flight calls each method on a thread of its own."""

    def __init__(
        self,
        store: Store,
        location: str,
        *,
        keyring: Keyring | None,
        certificates: list[tuple[bytes, bytes]] | None,
    ) -> None:
        self._uploads = Uploads(store)
        self._flights = Flights(store, self._uploads)
        self._backend = Backend(store, self._uploads)
        middleware = {MIDDLEWARE: KeyCheck(keyring)}
        super().__init__(location, tls_certificates=certificates, middleware=middleware)  # pyright: ignore[reportArgumentType] - PEM is bytes

    def drop_idle(self, idle_s: float) -> None:
        """Discard sessions whose clients have said nothing for so long."""
        self._uploads.discard_idle(idle_s)

    def drop_uploads(self) -> None:
        """Discard what was never finalized."""
        self._uploads.close()

    def list_flights(  # pyright: ignore[reportIncompatibleMethodOverride] - the criteria come as bytes
        self, context: fl.ServerCallContext, criteria: bytes
    ) -> Iterator[fl.FlightInfo]:
        """List the sequences."""
        with answered():
            require(context, Permission.READ)
            if criteria not in {b"", b"/"}:
                raise Refusal(Condition.INVALID, "list_flights takes no criteria but '/'")
            return iter(list(self._flights.listed()))

    def get_flight_info(
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.FlightInfo:
        """Describe a sequence or a topic."""
        with answered():
            require(context, Permission.READ)
            return self._flights.info(descriptor)

    def get_schema(  # pyright: ignore[reportIncompatibleMethodOverride] - Flight takes this wrapping only
        self, context: fl.ServerCallContext, descriptor: fl.FlightDescriptor
    ) -> fl.SchemaResult:
        """Return the columns of a topic."""
        with answered():
            require(context, Permission.READ)
            return fl.SchemaResult(self._flights.schema(descriptor))

    def do_get(self, context: fl.ServerCallContext, ticket: fl.Ticket) -> fl.FlightDataStream:
        """Stream a topic's rows."""
        with answered():
            require(context, Permission.READ)
            schema, batches = self._flights.rows(ticket)
            return fl.GeneratorStream(schema, _told(batches))

    def do_put(
        self,
        context: fl.ServerCallContext,
        descriptor: fl.FlightDescriptor,
        reader: fl.MetadataRecordBatchReader,
        writer: fl.FlightMetadataWriter,  # noqa: ARG002 - nothing is sent back before the end
    ) -> None:
        """Take the rows of a topic."""
        with answered():
            require(context, Permission.WRITE)
            if descriptor.descriptor_type is not fl.DescriptorType.CMD:
                raise Refusal(Condition.INVALID, "only descriptors with a command are understood")
            put = JSON.decode(bodies.Put, descriptor.command or b"")
            self._uploads.receive(put, reader.schema, _batches(reader))

    def do_action(self, context: fl.ServerCallContext, action: fl.Action) -> Iterator[bytes]:
        """Answer an action."""
        with answered():
            known = ACTIONS.get(action.type)
            if known is None or known not in ANSWERS:
                raise Refusal(Condition.UNIMPLEMENTED, f"action {action.type!r} is not implemented")
            require(context, known.permission)
            question = JSON.decode(known.question, action.body.to_pybytes() or b"{}")
            return iter([JSON.encode_answer(known, ANSWERS[known](self._backend, question))])


def _told(batches: Iterator[pa.RecordBatch]) -> Generator[pa.RecordBatch, None, None]:
    with answered():
        yield from batches


def _batches(reader: fl.MetadataRecordBatchReader) -> Iterator[pa.RecordBatch]:
    for chunk in reader:
        if chunk.data is None:
            raise Refusal(Condition.INVALID, "a message without rows came in the middle of an upload")
        yield chunk.data
