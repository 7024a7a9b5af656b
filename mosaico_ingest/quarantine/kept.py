"""This file finds what lies in a quarantine, and marks what has been replayed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.frozen import frozen
from mosaico_ingest.quarantine.quarantine import INDEX, MESSAGES, retire

__all__ = ["Kept", "find_kept"]


@frozen
class Kept:
    """The messages one run kept, and the sequence they belong to."""

    messages: Path
    sequence: str

    def mark_replayed(self) -> None:
        """Rename the messages, so that the next replay leaves them alone."""
        retire(self.messages, "replayed")


def find_kept(folder: Path) -> tuple[Kept, ...]:
    """Return what lies in a quarantine, the oldest of a sequence first.

    Raises:
        NothingMatched: It is empty.
        BagError: The index beside the messages is not there or cannot be read.
    """
    found = tuple(_kept(folder))
    if not found:
        raise NothingMatched(
            "there is nothing to replay", where=str(folder), hint="name a quarantine's folder"
        )
    return found


def _kept(folder: Path) -> Iterator[Kept]:
    for messages in sorted(folder.glob(f"*{MESSAGES}")):
        index = messages.with_suffix(INDEX)
        try:
            with index.open(encoding="utf-8") as lines:
                first = lines.readline()
            if first.endswith("\n"):  # else its run was killed before it had kept a message
                yield Kept(messages, str(json.loads(first)["sequence"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            why = getattr(error, "strerror", None) or error
            raise BagError(f"this is no index of a quarantine: {why}", where=str(index)) from error
