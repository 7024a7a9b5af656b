"""This file is the pressure of a fluid."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float64
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable
from mosaico_ingest.ontology.uncertainty import Varying

__all__ = ["Pressure"]


class Pressure(Stamped, Varying, Serializable):
    """An absolute pressure."""

    value: Float64
    """Pa."""
