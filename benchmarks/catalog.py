"""Measure the catalog of a store behind a URL: requests, bytes and time of listings, a filter, a commit and a snapshot.

    ./dev bench catalog                 100,000 sequences of ten topics
    ./dev bench catalog --sequences N   another number

The S3 service runs on this machine, in memory, so the times contain no network.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import urllib.request
from pathlib import Path

import pyarrow as pa
from measure import run

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests/support"))

from bucket_service import CONTROL, BucketService, bucket_service  # noqa: E402 - in the folder of the tests

from mosaico_ingest.destinations import topic_schema  # noqa: E402 - after the other import
from mosaico_ingest.destinations.store import Store, StoreSink  # noqa: E402 - after the other import
from mosaico_ingest.ontology.registry import OntologyType  # noqa: E402 - after the other import

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_EC2_METADATA_DISABLED": "true",
}
TOPICS, CHANGES = 10, 1000
SETTLED_S = 6
"""Seconds after which a snapshot recognizes documents by their time of change."""
POSITION = OntologyType(
    "Point", pa.struct([pa.field(name, pa.float64(), nullable=False) for name in ("x", "y", "z")])
)


def name_of(number: int) -> str:
    return f"drive_{number:07}"


def commit(store: Store, number: int) -> None:
    """Write a small sequence."""
    rows = [{"timestamp_ns": 1, "x": 1.0, "y": 2.0, "z": 3.0}]
    batch = pa.RecordBatch.from_pylist(rows, schema=topic_schema(POSITION))
    metadata = {"vehicle": {"id": str(number % 1000)}, "site": "north"}
    with StoreSink(store).open(name_of(number), metadata) as session:
        for topic in range(TOPICS):
            session.topic(f"/sensors/position_{topic}", POSITION, {"frame": "map"}).write(batch)


def fill(service: BucketService, store: Store, count: int) -> None:
    """Commit one sequence, and copy its document under the names of all others."""
    commit(store, 0)
    document = service.objects[f"store/catalog/{name_of(0)}.json"].content.decode()
    for number in range(1, count):
        content = document.replace(name_of(0), name_of(number)).replace(
            '"id": "0"', f'"id": "{number % 1000}"'
        )
        service.put(f"store/catalog/{name_of(number)}.json", content.encode())


def measured(service: BucketService, title: str, command: list[str]) -> str:
    """Run a command of the store and print a row of the table; return its output."""
    counted(service)
    sample = run([sys.executable, "-m", "mosaico_ingest", "store", *command], CREDENTIALS)
    print(row(title, counted(service), sample.wall_s, sample.cpu_s), flush=True)
    return sample.output


def counted(service: BucketService) -> dict[str, int]:
    """Return the requests by method, and the bytes, since the last call."""
    with urllib.request.urlopen(f"http://127.0.0.1:{service.port}{CONTROL}", timeout=60) as response:
        return json.load(response)


def row(title: str, counts: dict[str, int], wall_s: float, cpu_s: float) -> str:
    requests = {kind: count for kind, count in counts.items() if kind not in {"sent", "received"}}
    kinds = ", ".join(f"{count:,} {kind}" for kind, count in sorted(requests.items()))
    bytes_text = f"{(counts.get('sent', 0) + counts.get('received', 0)) / 1e6:.2f} MB"
    return (
        f"| {title} | {sum(requests.values()):,}: {kinds} | {bytes_text} | {wall_s:.2f} s | {cpu_s:.2f} s |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=int, default=100_000, help="number of sequences")
    count = parser.parse_args().sequences
    os.environ.update(CREDENTIALS)
    with bucket_service() as service:
        url = service.url("store")
        store = Store.open(url)
        fill(service, store, count)
        time.sleep(SETTLED_S)
        print(f"| {count:,} sequences | requests | bytes | time | CPU time |\n|---|---|---:|---:|---:|")
        page = ["ls", "--store", url, "--limit", "20", "--json"]
        measured(service, "first `store ls`, which reads all documents and writes the snapshot", page)
        output = measured(service, "`store ls --limit 20`", page)
        assert len(json.loads(output)) == 20
        output = measured(
            service, "the same with `--metadata vehicle.id=7`", [*page, "--metadata", "vehicle.id=7"]
        )
        assert len(json.loads(output)) == min(20, -(-(count - 7) // 1000))
        counted(service)
        start, start_cpu = time.perf_counter(), time.process_time()
        commit(store, count)
        print(
            row(
                "commit of a sequence",
                counted(service),
                time.perf_counter() - start,
                time.process_time() - start_cpu,
            )
        )
        measured(service, "`store ls --limit 20` after the commit", page)
        for number in range(CHANGES):
            document = service.objects[f"store/catalog/{name_of(number)}.json"].content
            service.put(f"store/catalog/{name_of(number)}.json", document.replace(b"north", b"south"))
            service.put(f"store/changes/{number:026}-{name_of(number)}", b"")
        title = f"`store ls --limit 20` after {CHANGES:,} other commits, which writes the next snapshot"
        measured(service, title, page)


if __name__ == "__main__":
    main()
