"""Clusters of timestamps, and their intersections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Range: TypeAlias = tuple[int, int]
"""The first and the last timestamp in nanoseconds, both inclusive."""


def clusterize(times: NDArray[np.int64], gap_ns: int) -> list[Range]:
    """Return the ranges of sorted timestamps that gaps longer than `gap_ns` separate; 0 returns one range."""
    if not len(times):
        return []
    ends = np.flatnonzero(np.diff(times) > gap_ns) if gap_ns else np.array([], np.int64)
    starts = times[np.append(0, ends + 1)]
    return list(zip(starts.tolist(), times[np.append(ends, len(times) - 1)].tolist(), strict=True))


def intersect(clusters: Sequence[Sequence[Range]], tolerance_ns: int) -> Iterator[Range]:
    """Yield the ranges in which every topic has a cluster, as the platform's server computes them.

    The walk compares one cluster per topic and then advances the topic whose cluster ends first. Clusters that do not
    overlap but are at most `tolerance_ns` apart yield their distance, widened by half the tolerance on each side.
    """
    if not all(clusters):
        return
    positions = [0] * len(clusters)
    before_ns, after_ns = tolerance_ns // 2, tolerance_ns - tolerance_ns // 2
    while True:
        current = [ranges[position] for ranges, position in zip(clusters, positions, strict=True)]
        first_end, topic = min((end, topic) for topic, (_, end) in enumerate(current))
        last_start = max(start for start, _ in current)
        if last_start <= first_end:
            yield last_start, first_end
        elif last_start <= first_end + tolerance_ns:
            yield last_start - before_ns, first_end + after_ns
        positions[topic] += 1
        if positions[topic] == len(clusters[topic]):
            return
