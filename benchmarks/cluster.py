"""Measure 10,000 small recordings on a Ray cluster of two nodes on this machine.

    ./dev bench cluster                  into a store behind a URL, and into a Mosaico server
    ./dev bench cluster --recordings N   another number of recordings

Each recording has one topic with eleven messages. The S3 service keeps its objects in memory, and `ingest serve` serves
a store on this disk, so that the cluster and the destination share the cores of this machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from measure import run
from scale import INGEST, write

from mosaico_ingest.report.run import read_report

SUPPORT = Path(__file__).resolve().parents[1] / "tests/support"
sys.path.insert(0, str(SUPPORT))
LINKS = 10_000
"""Maximum number of links to a file, less than file systems allow."""
CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_EC2_METADATA_DISABLED": "true",
}


def recordings(folder: Path, count: int) -> None:
    """Generate recordings; most of them are links."""
    folder.mkdir()
    for number in range(count):
        path = folder / f"{number:06}.mcap"
        if number % LINKS:
            os.link(folder / f"{number - number % LINKS:06}.mcap", path)
        else:
            write(path, 1, 11)


@contextmanager
def bucket() -> Iterator[str]:
    """Run the S3 service and yield the target of a store in its bucket."""
    command = [sys.executable, str(SUPPORT / "bucket_service.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        options = f"endpoint_override=127.0.0.1:{int(process.stdout.readline())}&scheme=http&region=us-east-1"
        try:
            yield f'store: "s3://bucket/store?{options}"'
        finally:
            process.kill()


@contextmanager
def server(folder: Path) -> Iterator[str]:
    """Run a Mosaico server and yield its target."""
    command = [*INGEST, "serve", "--store", str(folder / "served"), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        port = (
            next(line for line in process.stdout if "127.0.0.1:" in line)
            .partition("127.0.0.1:")[2]
            .split()[0]
        )
        try:
            yield f"host: 127.0.0.1, port: {int(port.rstrip('.,/'))}"
        finally:
            process.kill()


def measured(folder: Path, address: str, title: str, target: str, count: int) -> None:
    """Ingest the recordings into a target and print a row of the table."""
    job, report = folder / "job.yaml", folder / "run.jsonl"
    job.write_text(
        f'version: 1\nbag: {{path: "{folder}/recordings/*.mcap"}}\nsequence: {{name: "{{stem}}"}}\ntarget: {{{target}}}\n'
    )
    sample = run(
        [*INGEST, "run", job, "--quiet", "--executor", "ray", "--address", address, "--report", report]
    )
    summary = read_report(report).summary
    assert summary.written == 11 * count, summary
    rate = count / sample.wall_s
    print(
        f"| {title} | {sample.wall_s:.1f} s | {rate:.0f} /s | {sample.wall_s / count * 1e3:.1f} ms "
        f"| {sample.cpu_s:.1f} s | {sample.peak_bytes >> 20} MiB |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=int, default=10_000, help="number of recordings")
    count = parser.parse_args().recordings
    os.environ.update(CREDENTIALS)
    from ray_cluster import two_nodes  # noqa: PLC0415 - the workers have the credentials in their environment

    print(
        f"| {count:,} recordings | time | recordings | per recording | CPU of the driver | memory of the driver |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as name, two_nodes() as cluster:
        folder = Path(name)
        recordings(folder / "recordings", count)
        with bucket() as target:
            measured(folder, cluster.address, "store behind a URL", target, count)
        with server(folder) as target:
            measured(folder, cluster.address, "Mosaico server", target, count)


if __name__ == "__main__":
    main()
