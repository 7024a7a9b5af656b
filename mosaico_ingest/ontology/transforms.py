"""This file is several transforms sent at once."""

from __future__ import annotations

from mosaico_ingest.ontology.geometry import Transform
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["FrameTransform"]


class FrameTransform(Serializable):
    """Edges of the tree of frames."""

    transforms: list[Transform]
    """Each with its own header."""
