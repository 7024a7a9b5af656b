"""Fixtures of the store tests: a store, its sink and server, and small batches of rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from flight_calls import Client

from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import OntologyType
from mosaico_ingest.serve import Server, serve

SAMPLE = OntologyType("Sample", pa.struct([pa.field("value", pa.float64()), pa.field("source", pa.int32())]))

Rows = Callable[..., pa.RecordBatch]


def make_rows(times: Sequence[int], source: int = 0) -> pa.RecordBatch:
    stamps = np.asarray(times, dtype=np.int64)
    columns = [pa.array(stamps), pa.array(stamps / 2), pa.array(np.full(len(stamps), source, np.int32))]
    return pa.RecordBatch.from_arrays(columns, schema=topic_schema(SAMPLE))


@pytest.fixture(scope="session")
def rows() -> Rows:
    """Return the function that builds a batch of type `sample` from timestamps."""
    return make_rows


@pytest.fixture(scope="session")
def sample() -> OntologyType:
    """The ontology type of the batches built by `rows`."""
    return SAMPLE


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.open(tmp_path / "mosaico")


@pytest.fixture
def sink(store: Store) -> StoreSink:
    return StoreSink(store)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with serve(tmp_path / "served", port=0) as running:
        yield running


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    with Client(server) as connected:
        yield connected
