"""Clusters of timestamps, and their intersections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Range: TypeAlias = tuple[int, int]
"""The first and the last timestamp in nanoseconds, both inclusive."""


def clusterize(times: NDArray[np.int64], gap_ns: int) -> list[Range]:
    """Return the ranges of sorted timestamps that gaps of at least `gap_ns` separate; 0 returns one range."""
    if not len(times):
        return []
    ends = np.flatnonzero(np.diff(times) >= gap_ns) if gap_ns else np.array([], np.int64)
    starts = times[np.append(0, ends + 1)]
    return list(zip(starts.tolist(), times[np.append(ends, len(times) - 1)].tolist(), strict=True))


def intersect(clusters: Sequence[Sequence[Range]], tolerance_ns: int) -> list[Range]:
    """Return the ranges in which every topic has a cluster.

    Clusters that do not overlap but are at most `tolerance_ns` apart yield the range between them.
    """
    common = list(clusters[0])
    for others in clusters[1:]:
        common = _intersect(common, others, tolerance_ns)
    return common


def _intersect(first: Sequence[Range], second: Sequence[Range], tolerance_ns: int) -> list[Range]:
    """Return the sorted intersections of two sorted lists of ranges."""
    ranges: set[Range] = set()
    start = 0
    for low, high in first:
        while start < len(second) and second[start][1] + tolerance_ns < low:
            start += 1
        for other_low, other_high in second[start:]:
            if other_low - tolerance_ns > high:
                break
            bounds = (max(low, other_low), min(high, other_high))
            ranges.add((min(bounds), max(bounds)))
    return sorted(ranges)
