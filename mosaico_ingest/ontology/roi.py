"""This file is a part of a picture."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import UInt32
from mosaico_ingest.ontology.geometry import Vector2d
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["ROI"]


class ROI(Serializable):
    """A rectangle of pixels."""

    offset: Vector2d
    """Its left upper corner, pixels."""
    height: UInt32
    """pixels."""
    width: UInt32
    """pixels."""
    do_rectify: bool | None = None
    """Whether a rectified picture should be cut there too."""
