"""This file knows by which bytes a recording's kind is recognised, without the module that reads it."""

from __future__ import annotations

__all__ = ["MCAP", "ROS1", "ROSRECORD", "SQLITE", "ZSTD"]

MCAP = b"\x89MCAP0\r\n"
ROSRECORD = b"#ROSRECORD V1.2"
ROS1 = b"#ROS"
SQLITE = b"SQLite format 3\x00"
ZSTD = b"\x28\xb5\x2f\xfd"
