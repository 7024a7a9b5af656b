"""Measure the cost of a server: ingest one recording alternately into a store and through `ingest serve`.

Usage: python benchmarks/stream.py [RECORDING] [--copies 40] [--runs 3]

The default recording repeats the messages of `configs/quickstart/drive.mcap`. The output contains the ratio of the wall times
and the peak memory of client and server, which must not grow with the recording.
"""

from __future__ import annotations

import argparse
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from measure import Sample, run, typical
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

QUICKSTART = Path(__file__).resolve().parents[1] / "configs/quickstart/drive.mcap"
INGEST = (sys.executable, "-m", "mosaico_ingest")


def write_repeated(recording: Path, folder: Path, copies: int) -> Path:
    """Write a recording that contains the messages of another one `copies` times in succession."""
    target = folder / f"repeated_{copies}"
    with (
        AnyReader([recording]) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        connections = {
            one.id: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore)
            for one in reader.connections
        }
        length = reader.end_time - reader.start_time + 1
        for copy in range(copies):
            for connection, stamp, data in reader.messages():
                writer.write(connections[connection.id], stamp + copy * length, data)
    return target


@contextmanager
def serve(folder: Path) -> Generator[str, None, None]:
    """Serve an empty store and yield the port."""
    command = [*INGEST, "serve", "--store", folder, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().strip().rpartition(":")[2]
        server.send_signal(signal.SIGTERM)


def measure(recording: Path, folder: Path, runs: int) -> tuple[Sample, Sample]:
    """Return the median figures of runs into a store and of runs through a server."""
    direct: list[Sample] = []
    streamed: list[Sample] = []
    with serve(folder / "served") as port:
        for number in range(runs):
            command = [*INGEST, "bag", recording, "--name", f"run_{number}", "--quiet"]
            direct.append(run([*command, "--store", folder / "direct"]))
            streamed.append(run([*command, "--host", "127.0.0.1", "--port", port]))
    return typical(direct), typical(streamed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("--copies", type=int, default=40)
    parser.add_argument("--runs", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = arguments.recording or write_repeated(QUICKSTART, folder, arguments.copies)
        direct, streamed = measure(recording, folder, arguments.runs)
    ratio = streamed.wall_s / direct.wall_s
    server_peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss << 10
    print(f"store  {direct.wall_s:6.2f} s  {direct.peak_bytes >> 20:5} MiB")
    print(
        f"server {streamed.wall_s:6.2f} s  {streamed.peak_bytes >> 20:5} MiB  {ratio:.2f} times the time of the store"
    )
    print(f"largest process: {server_peak >> 20} MiB")


if __name__ == "__main__":
    main()
