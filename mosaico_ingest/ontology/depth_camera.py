"""This file is cameras that see depth."""

from __future__ import annotations

from mosaico_ingest.ontology.cloud import Cloud
from mosaico_ingest.ontology.fields import Float32, UInt8
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["RGBDCamera", "StereoCamera", "ToFCamera"]


class _Coloured(Cloud):
    rgb: list[Float32] | None = None
    """The colour, packed into the bits of a float as 0x00rrggbb."""
    intensity: list[Float32] | None = None
    """Brightness, in the sensor's unit."""


class RGBDCamera(_Coloured, Serializable):
    """A cloud from structured light."""


class ToFCamera(_Coloured, Serializable):
    """A cloud from the time light takes."""

    noise: list[Float32] | None = None
    """Of the distance, in the sensor's unit."""
    grayscale: list[Float32] | None = None
    """Brightness under the camera's own light."""


class StereoCamera(_Coloured, Serializable):
    """A cloud from two pictures."""

    luma: list[UInt8] | None = None
    """Brightness of the pixel."""
    cost: list[UInt8] | None = None
    """Of the match: 0 is certain."""
