"""This file is the calibration of a camera."""

from __future__ import annotations

from typing import Annotated

from mosaico_ingest.ontology.fields import FixedSize, Float64, UInt32
from mosaico_ingest.ontology.geometry import Vector2d
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.roi import ROI
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["CameraInfo"]


class CameraInfo(Stamped, Serializable):
    """How a camera maps space to pixels; matrices are row by row."""

    height: UInt32
    """pixels, at calibration."""
    width: UInt32
    """pixels, at calibration."""
    distortion_model: str
    """As `plumb_bob`."""
    distortion_parameters: list[Float64]
    """As many as the model has."""
    intrinsic_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 by 3, pixels: focal lengths and principal point of the raw picture."""
    rectification_parameters: Annotated[list[Float64], FixedSize(9)]
    """3 by 3: the rotation that makes a stereo pair's rows parallel."""
    projection_parameters: Annotated[list[Float64], FixedSize(12)]
    """3 by 4, pixels: of the rectified picture."""
    binning: Vector2d | None = None
    """Sensor pixels joined to one, across and down; null: none."""
    roi: ROI | None = None
    """The part of the sensor in use; null: all."""
