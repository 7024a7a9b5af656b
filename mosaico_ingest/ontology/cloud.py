"""This file is the columns that clouds of points have in common."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float32
from mosaico_ingest.ontology.header import Stamped

__all__ = ["Cloud"]


class Cloud(Stamped):
    """Points as lists of the same length, one for each coordinate."""

    x: list[Float32]
    """m."""
    y: list[Float32]
    """m."""
    z: list[Float32]
    """m."""
