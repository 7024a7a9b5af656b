"""This file chooses how the messages of a batch are walked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mosaico_ingest.decode.clustered import locate_clustered
from mosaico_ingest.decode.layout import Block, Layout
from mosaico_ingest.decode.lockstep import FEW, locate_lockstep
from mosaico_ingest.decode.places import Frame, Located, join
from mosaico_ingest.decode.stepwise import locate_stepwise

__all__ = ["locate"]

_LARGE_BYTES = 64 << 10
"""So many bytes of few messages may be long sequences, whose elements can be walked together."""


def locate(layout: Layout, frame: Frame) -> Located:
    """Find where everything lies in the messages that fit the layout."""
    if all(isinstance(step, Block) for step in layout.body.steps):
        return locate_lockstep(layout, frame)  # nothing in a message depends on its bytes
    parts = locate_clustered(layout, frame)
    left = np.ones(len(frame), bool)
    for part in parts:
        left[part.rows] = False
    rest = np.flatnonzero(left)
    if len(rest) or not parts:
        others = frame.take(rest)
        is_small = len(rest) <= FEW and int((others.ends - others.origins).sum()) < _LARGE_BYTES
        walk = locate_stepwise if is_small else locate_lockstep
        found = walk(layout, others)
        parts.append(replace(found, rows=rest[found.rows]))
    return _merge(parts)


def _merge(parts: list[Located]) -> Located:
    if len(parts) == 1:
        return parts[0]
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows)
    slots = np.empty(len(rows), np.int64)
    slots[order] = np.arange(len(rows))
    tails = np.concatenate([part.tails for part in parts])
    return Located(rows[order], tails[order], join([part.places for part in parts], slots))
