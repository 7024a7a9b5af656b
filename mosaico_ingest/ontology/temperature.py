"""This file is temperatures."""

from __future__ import annotations

from typing_extensions import Self

from mosaico_ingest.ontology.fields import Float64
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Varying

__all__ = ["Temperature"]

_ICE_K = 273.15


class Temperature(Stamped, Varying, Serializable):
    """An absolute temperature."""

    value: Float64
    """K."""

    @classmethod
    def from_celsius(cls, celsius: float) -> Self:
        """Return the temperature of so many °C."""
        return cls(value=celsius + _ICE_K)

    def to_celsius(self) -> float:
        """Return the temperature in °C."""
        return self.value - _ICE_K
