"""Fixtures: the store of the quickstart, and stores of given rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from mosaico_ingest import api
from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import OntologyType

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"

MakeStore = Callable[..., Store]


@pytest.fixture(scope="session")
def quickstart(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store with the sequence `quickstart_drive`."""
    folder = tmp_path_factory.mktemp("view") / "store"
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    api.run([job.replace(target=job.target.replace(store=str(folder)))])
    return Store.open(folder, create=False)


@pytest.fixture
def make_store(tmp_path: Path) -> MakeStore:
    """Return the function that writes topics to the sequence `made`: rows and their struct type by topic name."""

    def make(topics: Mapping[str, tuple[OntologyType, Sequence[Mapping[str, Any]]]]) -> Store:
        store = Store.open(tmp_path / "made")
        with StoreSink(store).open("made", {}) as session:
            for name, (ontology, rows) in topics.items():
                table = pa.Table.from_pylist([dict(row) for row in rows], topic_schema(ontology))
                writer = session.topic(name, ontology, {})
                for batch in table.to_batches(max_chunksize=7):
                    writer.write(batch)
        return store

    return make
