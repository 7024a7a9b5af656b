"""The fuzzing targets: each accepts arbitrary bytes, and may raise only errors of this package.

`python fuzz/targets.py TARGET [CORPUS] [-max_total_time=SECONDS]` fuzzes a target with atheris, guided by coverage.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path

import numpy as np

try:
    import atheris
except ImportError:  # only long runs need it
    atheris = None

with atheris.instrument_imports(include=["mosaico_ingest"]) if atheris else nullcontext():
    from mosaico_ingest.adapters.mapping.loader import load_adapter
    from mosaico_ingest.decode.decoder import decoder_for
    from mosaico_ingest.errors import IngestError
    from mosaico_ingest.job.manifest import check_manifest
    from mosaico_ingest.job.yaml_source import load_source
    from mosaico_ingest.protocol.messages import ACTIONS, JSON, Malformed
    from mosaico_ingest.rosbag import sqlite
    from mosaico_ingest.rosbag.blocks import Connection, Encoding, MessageBlock
    from mosaico_ingest.rosbag.definitions.model import Embedded
    from mosaico_ingest.rosbag.definitions.registry import TypeResolver
    from mosaico_ingest.rosbag.discovery import read_metadata
    from mosaico_ingest.rosbag.mcap import reader as mcap
    from mosaico_ingest.rosbag.recording import open_recording
    from mosaico_ingest.rosbag.ros1 import reader as ros1
    from mosaico_ingest.rosbag.ros1 import version_1_2 as rosrecord

__all__ = ["TARGETS"]

READERS = (mcap, ros1, rosrecord, sqlite)
"""Modules that are imported above so that atheris instruments them; they are otherwise loaded on demand."""

_RESOLVER = TypeResolver("ros2_humble")


def recording(data: bytes) -> None:
    """Read a file of any container to its end."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "recording")
        path.write_bytes(data)
        with suppress(IngestError), open_recording(path, resolve=_RESOLVER) as opened:
            for batch in opened.message_blocks():
                connection = opened.connections[batch.connection]
                if connection.definition is not None and connection.encoding is not Encoding.OTHER:
                    with suppress(IngestError):
                        decoder_for(connection).decode(batch)


def definition(data: bytes) -> None:
    """Parse a definition and decode a message of it; the first byte selects the format of the definition."""
    encoding = ("ros1msg", "ros2msg", "ros2idl")[data[0] % 3] if data else "ros2msg"
    text, _, payload = data[1:].partition(b"\0\0\0\0")
    embedded = Embedded(encoding, text.decode("utf-8", "replace"))
    ros1 = encoding == "ros1msg"
    with suppress(IngestError):
        resolved = _RESOLVER.resolve("pkg/msg/Fuzzed", embedded, ros_version=1 if ros1 else 2)
        connection = Connection(
            0, "/fuzzed", resolved.root, Encoding.ROS1 if ros1 else Encoding.CDR, 1, resolved
        )
        one = np.array([0], np.int64)
        buffer = np.frombuffer(payload, np.uint8)
        decoded = decoder_for(connection).decode(MessageBlock(0, one, buffer, one, one + len(payload), one))
        decoded.rows.validate(full=True)


def manifest(data: bytes) -> None:
    """Check the text of a manifest."""
    check_manifest(load_source(data.decode("utf-8", "replace"), file="job.yaml"), env={})


def adapter(data: bytes) -> None:
    """Load the text of an adapter with its expressions."""
    with suppress(IngestError):
        load_adapter(data.decode("utf-8", "replace"))


def metadata(data: bytes) -> None:
    """Read the `metadata.yaml` of a rosbag2 directory."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "metadata.yaml")
        path.write_bytes(data)
        with suppress(IngestError):
            read_metadata(path)


def wire(data: bytes) -> None:
    """Decode a request and a response of each action."""
    for action in ACTIONS.values():
        with suppress(Malformed):
            JSON.decode(action.question, data)
        with suppress(Malformed):
            JSON.decode_answer(action, data)


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target for target in (recording, definition, manifest, adapter, metadata, wire)
}


def main() -> None:
    """Fuzz the target that the command line selects."""
    if atheris is None or len(sys.argv) < 2 or sys.argv[1] not in TARGETS:  # noqa: PLR2004 - the name is required
        sys.exit(f"usage: python fuzz/targets.py {{{','.join(TARGETS)}}} [CORPUS] [-max_total_time=SECONDS]")
    atheris.Setup([sys.argv[0], *sys.argv[2:]], TARGETS[sys.argv[1]])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
