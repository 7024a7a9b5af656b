"""The base classes of the ontology, as in `mosaicolabs.models.core`."""

from mosaico_ingest.ontology import Message, Serializable, Unmodeled

__all__ = ["Message", "Serializable", "Unmodeled"]
