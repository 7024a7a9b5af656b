"""Stores for tests of pages: the quickstart, and a sequence of hostile texts and values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from mosaico_ingest import api
from mosaico_ingest.destinations import topic_schema
from mosaico_ingest.destinations.store import Store, StoreSink
from mosaico_ingest.ontology.registry import OntologyType

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"
NASTY = "</script><script>document.title = 'broken'</script>\x1b[2J\u202e&amp; \"'"
"""A text that would run a script and disguise other text if it was not escaped."""
S = 10**9
T0 = 1_700_000_000 * S

Topics = Mapping[str, tuple[OntologyType, Sequence[Mapping[str, Any]]]]


def store_quickstart(folder: Path) -> Store:
    """Return a store with the sequence `quickstart_drive`."""
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    api.run([job.replace(target=job.target.replace(store=str(folder)))])
    return Store.open(folder, create=False)


def write_sequence(
    store: Store, name: str, topics: Topics, metadata: Mapping[str, Any] | None = None
) -> None:
    """Write rows by topic name."""
    with StoreSink(store).open(name, dict(metadata or {})) as session:
        for topic, (ontology, rows) in topics.items():
            table = pa.Table.from_pylist([dict(row) for row in rows], topic_schema(ontology))
            writer = session.topic(topic, ontology, {})
            for batch in table.to_batches():
                writer.write(batch)


def ontology(tag: str, **fields: pa.DataType) -> OntologyType:
    """Return a type with these columns."""
    return OntologyType(tag, pa.struct([pa.field(name, kind) for name, kind in fields.items()]))


LOG = ontology("Log", level=pa.uint8(), name=pa.string(), msg=pa.string())
TEXT = ontology("String", data=pa.string())
NUMBERS = ontology("Numbers", value=pa.float64(), constant=pa.int32(), wheels=pa.list_(pa.float32()))
IMAGE = ontology("CompressedImage", data=pa.binary(), format=pa.string())


def write_hostile(store: Store) -> None:
    """Write the sequence `hostile`: every text is `NASTY`, numbers are NaN and infinite, and an image is damaged."""
    write_sequence(
        store,
        "hostile",
        {
            "/log": (LOG, [{"timestamp_ns": T0, "level": 8, "name": NASTY, "msg": NASTY}]),
            "/text": (TEXT, [{"timestamp_ns": T0 + at, "data": NASTY} for at in range(3)]),
            "/numbers": (
                NUMBERS,
                [
                    {
                        "timestamp_ns": T0 + at * S,
                        "value": [1.5, float("nan"), float("inf"), -2.0][at % 4],
                        "constant": 7,
                        "wheels": [at, -at],
                    }
                    for at in range(2000)
                ],
            ),
            "/broken_camera": (IMAGE, [{"timestamp_ns": T0, "data": b"no image", "format": "png"}]),
            "/empty": (TEXT, []),
        },
        {"vehicle": NASTY, "nested": {"deep": {"key": NASTY}}},
    )
