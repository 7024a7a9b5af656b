"""This file picks one machine's share of a batch, for job arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from mosaico_ingest.errors import ManifestError

__all__ = ["take_shard"]

T = TypeVar("T")


def take_shard(items: Sequence[T], shard: str) -> list[T]:
    """Return every n-th item from the i-th on, for a shard written `i/n` with i from 1.

    Raises:
        ManifestError: It is written otherwise.
    """
    first, _, count = shard.partition("/")
    if not (first.isdecimal() and count.isdecimal() and 1 <= int(first) <= int(count)):
        raise ManifestError(
            f"--shard is {shard!r}", hint="write the shard and how many there are, as 1/8 .. 8/8"
        )
    return list(items[int(first) - 1 :: int(count)])
