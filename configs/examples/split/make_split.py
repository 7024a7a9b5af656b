"""Write drive_0.mcap and drive_1.mcap: the IMU and GPS messages of the quickstart recording, split after five seconds.

Usage: python configs/examples/split/make_split.py [FOLDER]
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

HERE = Path(__file__).parent
RECORDING = HERE.parents[1] / "quickstart" / "drive.mcap"
TOPICS = ("/imu", "/gps/fix")
SPLIT_AFTER_NS = 5 * 10**9


def write_split(folder: Path, number: int) -> None:
    """Write the messages of one half of the recording to one file."""
    with tempfile.TemporaryDirectory() as scratch, AnyReader([RECORDING]) as reader:
        target = Path(scratch) / "bag"
        writer = Writer(target, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        selected = [connection for connection in reader.connections if connection.topic in TOPICS]
        with writer:
            connections = {
                one.id: writer.add_connection(one.topic, one.msgtype, typestore=reader.typestore)
                for one in selected
            }
            for connection, log_time, data in reader.messages(selected):
                if (log_time >= reader.start_time + SPLIT_AFTER_NS) == bool(number):
                    writer.write(connections[connection.id], log_time, data)
        shutil.move(next(target.glob("*.mcap")), folder / f"drive_{number}.mcap")


if __name__ == "__main__":
    destination = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE
    for half in (0, 1):
        write_split(destination, half)
