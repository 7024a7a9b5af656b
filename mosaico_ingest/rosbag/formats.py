"""This file knows by which bytes a recording's kind is recognised, and by which names, without the modules that read it."""

from __future__ import annotations

import re

__all__ = ["MCAP", "RECORDING_NAME", "ROS1", "ROSRECORD", "SQLITE", "ZSTD"]

MCAP = b"\x89MCAP0\r\n"
ROSRECORD = b"#ROSRECORD V1.2"
ROS1 = b"#ROS"
SQLITE = b"SQLite format 3\x00"
ZSTD = b"\x28\xb5\x2f\xfd"

RECORDING_NAME = re.compile(r"\.(bag|db3|mcap)(\.(zstd|zst|lz4|gz|bz2))?$", re.IGNORECASE)
"""How the name of a recording ends, packed or not."""
