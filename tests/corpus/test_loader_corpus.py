"""Comparison of the loader with rosbags on real recordings."""

from __future__ import annotations

import csv
import keyword
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore
from rosbags.typesys.store import Typestore

from mosaico_ingest.rosbag.loader import ROSLoader

PLACEHOLDER = "structure_needs_at_least_one_member"
_MAX_MESSAGES = 3_000
"""A recording is compared up to here; the long ones repeat themselves."""


def plain(value: Any, store: Typestore) -> Any:
    """Turn rosbags' objects and arrays into dictionaries and lists."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [plain(element, store) for element in value]
    if not hasattr(value, "__msgtype__"):
        return value
    names = [name for name, _ in store.fielddefs[value.__msgtype__][1] if name != PLACEHOLDER]
    return {name: plain(getattr(value, name + "_" * keyword.iskeyword(name)), store) for name in names}


def same(ours: Any, theirs: Any) -> bool:
    """Compare, taking `bytes` for lists and NaN for equal; rosbags reads a `byte` as signed."""
    if isinstance(ours, dict):
        return ours.keys() == theirs.keys() and all(same(part, theirs[name]) for name, part in ours.items())
    if isinstance(ours, list | bytes):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if isinstance(ours, float) and math.isnan(ours):
        return isinstance(theirs, float) and math.isnan(theirs)
    return bool(ours == theirs or (isinstance(ours, int) and theirs < 0 and ours == theirs + 256))


def known_to_rosbags(path: Path) -> dict[tuple[int, str], list[Any]]:
    """Return rosbags' messages by time and topic; none where it cannot read the recording."""
    actual: dict[tuple[int, str], list[Any]] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(RosbagsStores.ROS2_HUMBLE)) as reader:
            for number, (connection, time, raw) in enumerate(reader.messages()):
                if number >= _MAX_MESSAGES:
                    break
                message = reader.deserialize(raw, connection.msgtype)
                actual.setdefault((time, connection.topic), []).append(plain(message, reader.typestore))
    except (AnyReaderError, KeyError, AssertionError):
        return {}
    return actual


@pytest.mark.slow
def test_loader_reads_every_message_that_rosbags_reads_equally(corpus: Path) -> None:
    with (corpus / "INDEX.tsv").open(encoding="utf-8", newline="") as file:
        paths = [row["path"] for row in csv.DictReader(file, delimiter="\t")]
    compared = 0
    for path in paths:
        theirs = known_to_rosbags(corpus / path)
        if not theirs:
            continue
        with ROSLoader(corpus / path, error_policy="ignore") as loader:
            for message, error in loader:
                if error is not None:
                    continue
                candidates = theirs.get((message.timestamp_ns, message.topic), [])
                match = next((other for other in candidates if same(message.data, other)), None)
                assert match is not None or not candidates, f"{path}: {message.topic} {message.timestamp_ns}"
                if match is not None:
                    candidates.remove(match)
                    compared += 1
        left = Counter(topic for (_, topic), rest in theirs.items() if rest)
        assert not left, f"{path}: not read: {left}"
    assert compared > 40_000


def test_custom_msgs_open_a_recording_without_definitions(corpus: Path) -> None:
    types = {
        "turtlesim/msg/Color": "uint8 r\nuint8 g\nuint8 b",
        "turtlesim/msg/Pose": "".join(
            f"float32 {name}\n" for name in ("x", "y", "theta", "linear_velocity", "angular_velocity")
        ),
    }
    with ROSLoader(
        corpus / "roboto-ai__robologs-ros-actions/input/tiny.db3", custom_types=types, error_policy="raise"
    ) as loader:
        assert sum(1 for _ in loader) == loader.msg_count() == 2352
