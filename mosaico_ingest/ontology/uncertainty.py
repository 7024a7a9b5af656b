"""This file is the columns that say how sure a value is."""

from __future__ import annotations

from pydantic import BaseModel

from mosaico_ingest.ontology.fields import Float64, Int16
from mosaico_ingest.ontology.header import Stamped

__all__ = ["Uncertain", "Varying"]


class Uncertain(Stamped):
    """A stamped value of several components."""

    covariance: list[Float64] | None = None
    """The covariance matrix row by row, in the square of the components' units; null where it is not known."""
    covariance_type: Int16 | None = None
    """How the covariance came about, in the sender's code."""


class Varying(BaseModel):
    """A value of one component; these columns come before its header."""

    variance: Float64 | None = None
    """In the square of the value's unit; null where it is not known."""
    variance_type: Int16 | None = None
    """How the variance came about, in the sender's code."""
