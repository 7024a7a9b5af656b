"""Uploads that a client builds by hand: batches without offsets, malformed batches and missing values."""

from __future__ import annotations

import pyarrow as pa
import pytest
from flight_calls import Client, descriptor_of, refused
from hollow_batches import hollow_batch, malformed_batch

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.store import verify
from mosaico_ingest.ontology.registry import MODULES, OntologyType, ontology_type
from mosaico_ingest.protocol.errors import Condition
from mosaico_ingest.serve import Server

NESTED = OntologyType("Nested", pa.struct([pa.field("a", pa.list_(pa.list_(pa.list_(pa.int8()))))]))
TYPES = [*map(ontology_type, sorted(MODULES)), NESTED]


@pytest.mark.parametrize("ontology", TYPES, ids=lambda ontology: ontology.tag)
def test_uploaded_batches_without_offsets_are_read_back_unchanged(
    client: Client, server: Server, ontology: OntologyType
) -> None:
    schema = topic_schema(ontology)
    client.call("sequence_create", locator="drive", user_metadata={})
    client.upload("drive", "/t", hollow_batch(schema, 0), hollow_batch(schema, 3), tag=ontology.tag)
    assert [checked.problem for checked in verify(Store.open(server.store_path).sequence("drive"))] == [None]
    info = client.flight.get_flight_info(descriptor_of(resource_locator="drive/t"), client.options)
    rows = client.flight.do_get(info.endpoints[0].ticket, client.options).read_all()
    expected = pa.Table.from_batches([hollow_batch(schema, 3)])
    assert rows.replace_schema_metadata(None).equals(expected)


def test_upload_of_batch_with_offsets_out_of_range_is_refused(client: Client) -> None:
    client.call("sequence_create", locator="drive", user_metadata={})
    with refused(Condition.INVALID):
        client.upload("drive", "/t", malformed_batch())


def test_upload_of_row_without_timestamp_is_refused_as_invalid(client: Client) -> None:
    schema = pa.schema([pa.field("timestamp_ns", pa.int64()), pa.field("a", pa.int8())])
    batch = pa.RecordBatch.from_arrays(
        [pa.array([None], pa.int64()), pa.array([1], pa.int8())], schema=schema
    )
    client.call("sequence_create", locator="drive", user_metadata={})
    with refused(Condition.INVALID):
        client.upload("drive", "/t", batch)
