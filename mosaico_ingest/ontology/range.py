"""This file is distance sensors with a cone of sight."""

from __future__ import annotations

from pydantic import model_validator
from typing_extensions import Self

from mosaico_ingest.ontology.fields import Float32, UInt8
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Varying

__all__ = ["Range"]


class Range(Stamped, Varying, Serializable):
    """One distance, which lies between the sensor's bounds."""

    radiation_type: UInt8
    """0 ultrasound, 1 infrared."""
    field_of_view: Float32
    """The cone's full angle, rad."""
    min_range: Float32
    """m."""
    max_range: Float32
    """m."""
    range: Float32
    """m."""

    @model_validator(mode="after")
    def _lies_between(self) -> Self:
        if not self.min_range <= self.range <= self.max_range:
            raise ValueError(
                f"range {self.range} is not between min_range {self.min_range} and max_range {self.max_range}"
            )
        return self
