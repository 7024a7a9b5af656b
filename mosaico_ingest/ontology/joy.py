"""This file is hand controllers."""

from __future__ import annotations

from mosaico_ingest.ontology.fields import Float32, Int32
from mosaico_ingest.ontology.header import Stamped
from mosaico_ingest.ontology.serializable import Serializable

__all__ = ["Joy"]


class Joy(Stamped, Serializable):
    """The state of every axis and button."""

    axes: list[Float32]
    """-1 to 1 each."""
    buttons: list[Int32]
    """0 released, 1 pressed."""
