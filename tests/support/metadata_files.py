"""MCAP files with metadata records and side-car files."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcap.writer import IndexType, Writer


def write(
    path: Path,
    records: Mapping[str, Mapping[str, str]] | None = None,
    *,
    sidecar: Any = None,
    indexed: bool = True,
    truncated: bool = False,
) -> Path:
    """Write an MCAP file with two std_msgs/Int32 messages and metadata records."""
    buffer = io.BytesIO()
    writer = Writer(buffer, index_types=IndexType.ALL if indexed else IndexType.ALL & ~IndexType.METADATA)
    writer.start()
    schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data\n")
    channel = writer.register_channel("/count", "cdr", schema)
    for number in range(2):
        data = b"\x00\x01\x00\x00" + number.to_bytes(4, "little")
        time_ns = 1_000_000_000 + number
        writer.add_message(channel, time_ns, data, time_ns)
    for name, entries in (records or {}).items():
        writer.add_metadata(name, dict(entries))
    writer.finish()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.getvalue()[: -20 if truncated else None])
    if sidecar is not None:
        text = sidecar if isinstance(sidecar, str) else json.dumps(sidecar)
        path.with_suffix(".json").write_text(text)
    return path
