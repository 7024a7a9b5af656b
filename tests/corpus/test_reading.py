"""Real recordings: every message is read, or the reason is reported."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from mosaico_ingest.errors import BagError
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded
from mosaico_ingest.rosbag.recording import open_recording

MORE_THAN_KNOWN = {"Tiryoh__rosbag-analyzer-web/test_truncated.bag": 3}
"""Of this chunk, cut off with the file, three messages are whole."""
REFUSED = {
    "cruise-automation__rosbag.js/empty-file.bag": "the file is empty",
    "foxglove__rosbag/empty-file.bag": "the file is empty",
}


class BlindResolver:
    """Knows no type: this is about bytes."""

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        raise BagError(f"{msgtype} of ROS {ros_version} is not looked for, nor in {embedded}")


@pytest.mark.slow
def test_corpus_recording_every_message_is_read(corpus: Path) -> None:
    with (corpus / "INDEX.tsv").open(encoding="utf-8", newline="") as file:
        entries = list(csv.DictReader(file, delimiter="\t"))
    wrong: list[str] = []
    for entry in entries:
        name = entry["path"]
        expected = MORE_THAN_KNOWN.get(name, int(entry["messages"]))
        try:
            with open_recording(corpus / name, resolve=BlindResolver()) as recording:
                actual = sum(len(batch) for batch in recording.message_blocks())
                if actual != expected or recording.message_count not in {None, actual}:
                    wrong.append(
                        f"{name}: {actual} read, {recording.message_count} promised, {expected} known"
                    )
        except BagError as err:
            if REFUSED.get(name, "\n") not in str(err):
                wrong.append(f"{name}: {err}")
    assert wrong == []
    assert len(entries) > 200
